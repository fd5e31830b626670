"""Every command in README and docs, carried out against a real daemon, and the files that docs tell of."""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader

from polecal.daemon import manual
from polecal.daemon.config import Config
from polecal.daemon.control import Client
from polecal.daemon.finalise import finalise

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FORMATS = (ROOT / "docs" / "file-formats.md").read_text(encoding="utf-8")
PROGRAMS = (
    "polecal-field",
    "polecald",
    "./dev",
    "sudo",
    "systemd/install",
    "systemctl",
    "journalctl",
    "setfacl",
    "man",
)
MODULES = {"polecal-field": "polecal.daemon.field", "polecald": "polecal.daemon.service"}


def commands():
    """Give what is to be typed: lines of shell blocks, and what begins with a program's name in backticks."""
    found = {}
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        blocks = re.findall(r"^```sh\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
        bare = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
        said = (" ".join(each.split()) for each in re.findall(r"`([^`]+)`", bare))
        typed = [line.partition(" #")[0].strip() for line in "".join(blocks).splitlines()]
        for command in chain(typed, (each for each in said if re.match(r"\S+ \S", each + " "))):
            if command.split()[0] in PROGRAMS and command not in PROGRAMS:
                found[command] = page.name
    return found


COMMANDS = commands()
OURS = [command for command in COMMANDS if command.split()[0] in MODULES]
OTHERS = [command for command in COMMANDS if command not in OURS]


def test_commands_are_found_and_nothing_in_a_shell_block_is_overlooked():
    assert len(OURS) > 20
    for page in PAGES:
        for block in re.findall(r"^```sh\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE):
            for line in block.splitlines():
                assert line.partition(" #")[0].strip() in COMMANDS, line


# --- what this machine's own programs are asked


@pytest.mark.parametrize("command", OTHERS)
def test_what_other_programs_are_asked_is_of_something_that_is_there(command):
    words = shlex.split(command)
    if words[0] == "sudo":
        words = words[1:]
    match words:
        case ["./dev", verb, *names]:
            usage = subprocess.run([ROOT / "dev"], capture_output=True, text=True, check=False)
            assert usage.returncode == 2
            assert verb in re.split(r"[|\s]", usage.stderr)
            if verb == "bench":
                assert all((ROOT / "tests" / "bench" / f"bench_{name}.py").exists() for name in names)
        case ["systemd/install", *options]:
            if not Path("/usr/bin/python3").exists():
                pytest.skip("no /usr/bin/python3 here")
            command = [ROOT / "systemd" / "install", *{*options, "--dry-run"}]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stderr
        case ["systemctl", "start" | "status" | "reload", unit] | ["journalctl", "-u", unit]:
            assert (ROOT / "systemd" / f"{unit}.service").exists()
        case ["setfacl", "-m", entry, path]:
            config = Config.model_fields["runtime_dir"].default
            assert re.fullmatch(r"u:NAME:r?w?x?", entry)
            assert Path(path) in (config, config / "control.sock")
        case ["man", page]:
            assert page in {name.rpartition("/")[2].rpartition(".")[0] for name in manual.pages()}
        case _:
            pytest.fail(f"nobody knows how to look at {command}")


# --- what our own are asked, against emulated devices


class Desk:
    """Where an operator types: a folder with polecal.yaml in it, and a daemon to talk to."""

    def __init__(self, bench, session):
        self.bench = bench
        self.session = session
        self.done = set()

    def out(self, verb):
        """Give the folder that a verb writes to."""
        return self.bench.folder / f"out-{verb}"

    def command(self, typed):
        """Put in what stands for something else; give what to run."""
        words = shlex.split(typed)
        names = {
            "SESSION": self.session.name,
            "20261122T031500Z-yard/": f"{self.session}/",
            "capture.mcap": str(self.session / "capture.mcap"),
            "DIR": str(self.out(words[1])),
            "FILE": str(self.bench.folder / "dump"),
        }
        return [sys.executable, "-m", MODULES[words[0]], *(names.get(word, word) for word in words[1:])]

    def start(self, typed):
        self.done.add(typed)
        environment = os.environ | {"POLECAL_SOCKET": str(self.bench.config.socket)}
        return subprocess.Popen(
            self.command(typed),
            **{"cwd": self.bench.folder, "env": environment, "text": True},
            **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE},
        )

    def run(self, typed, codes=(0,)):
        with self.start(typed) as process:
            out, err = process.communicate(timeout=300.0)
        assert process.returncode in codes, (typed, process.returncode, out, err)
        return out

    def left(self, *verbs):
        """What of these verbs was not done yet, in the order of the pages."""
        return [each for each in OURS if each not in self.done and each.split()[1] in verbs]


@pytest.fixture
def desk(bench, recorded):
    """The desk, with the recorded drive as the last session."""
    session = bench.folder / "state" / "sessions" / recorded.session.id
    shutil.copytree(recorded.session.folder, session)
    return Desk(bench, session)


# What needs another session than one that has ended, or the outcome of another command; and what cannot do
# without more words, or takes minutes, and is named alone where a text speaks of it.
LATER = {"export", "decode", "start", "status", "wait", "stop", "replay"}
ALONE = ("demo", "replay", "import", "export", "decode", "drop", "keep")


def test_every_command_of_ours_does_what_it_is_there_for(desk, recorded, running, until):
    (desk.bench.folder / "polecal.yaml").write_text(yaml.safe_dump(desk.bench.content))
    daemon = "polecald --config polecal.yaml"
    desk.run(f"{daemon} --check-config")
    with desk.start(daemon) as process:
        until(desk.bench.config.socket.exists)
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=60.0)
    assert process.returncode == 0

    with running(desk.bench), Client(desk.bench.config.socket) as client:
        for typed in desk.left(*ALONE):
            if len(typed.split()) == 2:
                assert "usage" in desk.run(f"{typed} --help")
                desk.done.add(typed)
        for typed in desk.left("doctor"):
            assert "front" in desk.run(typed, codes=(0, 1))
        for typed in desk.left(*{each.split()[1] for each in OURS} - LATER):
            assert desk.run(typed), typed
        for typed in desk.left("export"):
            desk.run(typed)
            (dump,) = desk.out("export").glob("front*.bin")
            (desk.bench.folder / "dump").write_bytes(dump.read_bytes()[:100_000])
        for typed in desk.left("decode"):
            assert '"ranges_m"' in desk.run(typed)

        (yard,) = [typed for typed in desk.left("start") if "--name yard" in typed]
        assert "yard" in desk.run(yard)
        with desk.start("polecal-field wait") as waiting:
            watched = "polecal-field status --watch"
            with desk.start(watched) as watching:
                assert watching.stdout.readline()
                watching.send_signal(signal.SIGINT)
                watching.communicate(timeout=30.0)
            for typed in desk.left("status"):
                desk.run(typed, codes=(0, 1))
            until(lambda: client.request({"class": "STATUS"})["lasers"][0]["passes"] > 0, 30.0)
            assert "rejected" in desk.run("polecal-field stop --calibrate", codes=(5,))  # one pass is too few
            waiting.communicate(timeout=60.0)
        assert waiting.returncode == 5
        (again,) = desk.left("start")
        assert desk.session.name in desk.run(again)
        client.request({"class": "STOP"})
    for typed in desk.left("replay"):
        desk.run(typed)
        replayed, chosen = (
            yaml.safe_load((path / "calibration.yaml").read_text())["lasers"][0]["estimate"]
            for path in (desk.out("replay"), desk.session)
        )
        assert replayed == recorded.played.laser()["estimate"]
        assert chosen == pytest.approx(replayed)  # a pass was dropped, and taken back
    assert [typed for typed in OURS if typed not in desk.done] == []


# --- what the files hold


def table(heading):
    """Give the names in the first column of the tables below a heading."""
    part = FORMATS.split(f"## {heading}\n")[1].split("\n## ")[0]
    rows = re.findall(r"^\| (`.*?) \|", part, re.MULTILINE)
    return [name for row in rows for name in re.findall(r"`([^`]+)`", row)]


def test_a_passs_file_has_the_arrays_that_are_told_in_their_shapes(recorded):
    (first, *_) = sorted((recorded.session.folder / "passes").glob("front-*.npz"))
    assert re.fullmatch(r"front-\d{3}\.npz", first.name)
    with np.load(first) as file:
        shapes = {name: file[name].shape for name in file.files}
        k = file["block_features"].sum(axis=1)
    assert sorted(table("passes/NAME-NNN.npz")) == sorted(shapes)
    sizes_of = {
        "N": len(np.load(first)["range_m"]),
        "B": len(np.load(first)["block_count"]),
        "T": int((k * (k + 1) // 2).sum()),
    }
    part = FORMATS.split("## passes/NAME-NNN.npz\n")[1].split("\n## ")[0]
    for names, told in re.findall(r"^\| (`.*?) \| (.*?) \|", part, re.MULTILINE):
        every = re.findall(r"`([^`]+)`", names)
        wanted = told.split("; ") if ";" in told else [told] * len(every)
        for name, shape in zip(every, wanted, strict=True):
            sizes = [] if shape == "–" else [sizes_of.get(size) or int(size) for size in shape.split(" × ")]
            assert shapes[name] == tuple(sizes), name


def test_a_calibration_has_the_keys_that_are_told(recorded):
    content = yaml.safe_load((recorded.session.folder / "calibration.yaml").read_text())
    told = set(table("calibration.yaml"))
    assert told == {*content, *chain.from_iterable(content["lasers"])}


def test_a_sessions_folder_and_its_capture_are_as_told(recorded, tmp_path):
    folder = tmp_path / recorded.session.id
    shutil.copytree(recorded.session.folder, folder)
    assert {path.name for path in folder.iterdir()} == {
        *("session.yaml", "capture.mcap", "passes", "calibration.yaml"),
    }
    assert finalise(folder / "capture.mcap").not_decoded is None
    with (folder / "capture.mcap").open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        records = {record.name for record in reader.iter_metadata()}
    told = {name.replace("NAME", "front") for name in table("capture.mcap") if name.startswith("/")}
    topics = {channel.topic for channel in summary.channels.values()}
    assert {topic for topic in topics if not topic.startswith("/span/")} <= told
    assert told - topics <= {"/front/tx"}  # in virtual time nobody speaks to the devices
    assert {"/span/rx", "/span/fix"} <= topics
    schemas = {channel.topic: summary.schemas.get(channel.schema_id) for channel in summary.channels.values()}
    for topic, schema in re.findall(r"^\| `(/\S+)` \| `((?:foxglove|polecal)\.\w+)`", FORMATS, re.MULTILINE):
        assert schemas[topic.replace("NAME", "front")].name == schema
    assert records == {"polecal", "polecal.decoded"}
    assert all(f"`{record}`" in FORMATS for record in records)


def test_events_are_those_that_are_told():
    written = set()
    for path in (ROOT / "daemon").glob("*.py"):
        written |= set(re.findall(r'"event": "([^"]+)"', path.read_text()))
    written |= {"begin", "finish", "tick", "choice"}
    assert all(f"`{event}`" in FORMATS for event in written)
