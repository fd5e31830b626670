"""A systemd of the tests' own, in namespaces over a copy-on-write view of this one, with polecal installed.

What is there is what a vehicle's computer has: the system's Python, systemd as PID 1, no network, and polecal
by the README's one command. Everything that is written stays in a temporary folder, in memory if it can.
"""

import os
import re
import shutil
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml

from polecal.calib import KEYS
from polecal.daemon.control import Client
from polecal.drivers.emulated.world import HAND_MEASURED

ROOT = Path(__file__).parents[2]
SYSTEMD = "/usr/lib/systemd/systemd"
PLAIN = {"PATH": "/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin", "LANG": "C.UTF-8"}
_BOOT_S = 20.0
_ROOM_BYTES = 2_000_000_000  # four times what it takes

# view FOLDER NAME LOWER: LOWER as the root, with what is written in FOLDER/NAME
VIEW = """
set -eu
mount --make-rprivate /
mkdir -p "$1/$2" "$1/$2.work" "$1/$2.root"
mount -t overlay overlay -o "lowerdir=$3,upperdir=$1/$2,workdir=$1/$2.work" "$1/$2.root"
cd "$1/$2.root"
shift 3
mount -t proc proc proc
"""
# the project at /mnt, which cannot be written to
PROJECT = """
mount --bind "$1" mnt && mount -o remount,ro,bind mnt
"""
CHROOT = """
mount --rbind /dev dev
chroot . /bin/sh -euc "cd /mnt; $2"
"""
BOOT = """
mount -t sysfs sysfs sys
mount -t cgroup2 cgroup2 sys/fs/cgroup
mount -t tmpfs tmpfs run
mount -t tmpfs tmpfs tmp
mount -t tmpfs -o mode=755 tmpfs dev
for node in null:3 zero:5 full:7 random:8 urandom:9; do mknod -m 666 "dev/${node%:*}" c 1 "${node#*:}"; done
mkdir dev/pts dev/shm
mount -t devpts -o newinstance,ptmxmode=0666,mode=620 devpts dev/pts
ln -s pts/ptmx dev/ptmx
mkdir -p run/systemd/system
printf '[Unit]\\nDefaultDependencies=no\\nWants=systemd-journald.service\\n' >run/systemd/system/test.target
exec env -i container=other "PATH=$PATH" chroot . "$2" --system --unit=test.target --show-status=no
"""
EMULATED = """
[Service]
User=polecal
RuntimeDirectory=emulated
StandardOutput=truncate:/run/truth
ExecStart=/opt/polecal/bin/polecal-field emulate --lms-link /run/emulated/lms --span-link /run/emulated/span
"""


def _until(ask, timeout_s=15.0):
    """Wait until something is true, and give it; fail with what it was last."""
    deadline_s = time.monotonic() + timeout_s
    while not (answer := ask()):
        assert time.monotonic() < deadline_s, answer
        time.sleep(0.05)
    return answer


def _run(command, **how):
    return subprocess.run(command, capture_output=True, text=True, check=False, **how)


@pytest.fixture(scope="session")
def until():
    """Wait until something is true, and give it."""
    return _until


@pytest.fixture(scope="session")
def cgroup2():
    """Where the unified hierarchy of control groups is."""
    if os.geteuid() != 0:
        pytest.skip("only root can have a systemd of its own")
    for program in (SYSTEMD, "unshare", "nsenter", "systemd-sysusers", "/usr/bin/python3"):
        if shutil.which(program) is None:
            pytest.skip(f"no {program} here")
    for line in Path("/proc/mounts").read_text().splitlines():
        _, place, kind, options, *_ = line.split()
        if kind == "cgroup2" and "rw" in options.split(","):
            return Path(place)
    pytest.skip("no cgroup2 here that may be written to")


@dataclass
class Image:
    """A machine that is off, with polecal installed."""

    folder: Path

    def view(self, name, lower=None):
        """Give the arguments of a shell's script in a view of it; what is written is there as NAME."""
        return ["sh", self.folder, name, lower or f"{self.folder}/installed:/"]

    def run(self, name, script, lower=None):
        """Run a script as root in a view of it, with this machine's network and the project at /mnt."""
        enter = ["unshare", "--mount", "--pid", "--fork", "sh", "-c", VIEW + PROJECT + CHROOT]
        command = [*enter, *self.view(name, lower), ROOT, script]
        return _run(command, env=os.environ | PLAIN, timeout=600)


@pytest.fixture(scope="session")
def image(cgroup2):
    """A machine on which the README's command was run."""
    memory = Path("/dev/shm")
    roomy = memory.is_dir() and shutil.disk_usage(memory).free > _ROOM_BYTES
    made = Image(Path(tempfile.mkdtemp(prefix="polecal-machine-", dir=memory if roomy else None)))
    made.folder.chmod(0o755)
    (command,) = re.findall(r"^sudo (systemd/install)$", (ROOT / "README.md").read_text(), re.MULTILINE)
    try:
        done = made.run("none", "true", lower="/")
        if done.returncode:
            pytest.skip(f"no view of / by overlayfs here: {done.stderr.strip()}")
        done = made.run("installed", command, lower="/")
        if "Could not find a version" in done.stderr or "Temporary failure" in done.stderr:
            pytest.skip(f"no package index to install from: {done.stderr.strip()[-200:]}")
        assert done.returncode == 0, done.stderr
        yield made
    finally:
        shutil.rmtree(made.folder)


@dataclass
class Machine:
    """A booted machine, its PID 1 being ``pid`` here."""

    pid: int

    def path(self, inside):
        """Give where one of its files is for us."""
        return Path(f"/proc/{self.pid}/root{inside}")

    def run(self, *command, check=True, timeout_s=60):
        enter = ["nsenter", "-t", str(self.pid), "-m", "-u", "-i", "-n", "-p", "-C", "-r", "-w"]
        done = _run([*enter, *map(str, command)], env=PLAIN, timeout=timeout_s)
        assert not check or done.returncode == 0, (command, done.stdout, done.stderr)
        return done

    def systemctl(self, *arguments, check=True):
        return self.run("systemctl", "--no-pager", *arguments, check=check)

    def show(self, key):
        return self.systemctl("show", "--value", "--property", key, "polecal").stdout.strip()

    def says(self, *words, timeout_s=15.0):
        """Wait until the status line of `systemctl status` has all the words."""
        _until(lambda: all(word in self.show("StatusText") for word in words), timeout_s)

    @property
    def journal(self):
        """What the present unit's processes have said, and systemd about them."""
        since = self.path("/run/since").read_text()
        arguments = ["--no-pager", "--output=cat", "--after-cursor", since, "--unit=polecal"]
        return self.run("journalctl", *arguments).stdout

    def mark(self):
        """Let the journal begin here."""
        said = self.run("journalctl", "--no-pager", "--lines=1", "--show-cursor", "--quiet").stdout
        self.path("/run/since").write_text(said.rpartition("-- cursor: ")[2].strip())

    def client(self, timeout_s=60.0):
        return Client(self.path("/run/polecal/control.sock"), timeout_s)

    def ask(self, request, **more):
        with self.client() as client:
            return client.request({"class": request, **more})

    def configure(self, **changes):
        """Write the operator's configuration, for the emulated devices."""
        mount = {key: getattr(HAND_MEASURED, key) for key in KEYS}
        content = {
            "lasers": [{"name": "front", "port": "/run/emulated/lms", "mount": mount}],
            "navigation": {"port": "/run/emulated/span"},
            "pole": {"radius_m": 0.04, "height_m": 2.4},
            "storage": {"min_free_mb": 50},
        }
        self.path("/etc/polecal/polecal.yaml").write_text(yaml.safe_dump(content | changes))

    def override(self, text):
        """Change the unit's own settings for a test."""
        folder = self.path("/run/systemd/system/polecal.service.d")
        folder.mkdir(exist_ok=True)
        (folder / "test.conf").write_text(f"[Service]\n{text}\n")
        self.systemctl("daemon-reload")

    def collecting(self):
        """Begin a session, and return its folder once data is being collected."""
        session = self.ask("START", name="test")["session"]
        _until(lambda: self.ask("STATUS")["state"] == "collecting", 60.0)
        return self.path(f"/var/lib/polecal/sessions/{session}")


@pytest.fixture(scope="session")
def machine(cgroup2, image):
    """The machine with polecal installed, booted."""
    group = cgroup2 / image.folder.name
    group.mkdir()
    namespaces = ["unshare", "-p", "-f", "-m", "-u", "-i", "-n", "-C", "--kill-child"]
    into = f'echo 0 >"{group}/cgroup.procs"; exec "$@"'
    view = [*image.view("booted"), ROOT, SYSTEMD]
    boot = ["sh", "-c", into, "sh", *namespaces, "sh", "-c", VIEW + PROJECT + BOOT, *view]
    log = image.folder / "boot.log"
    with log.open("wb") as said, subprocess.Popen(boot, stderr=said, stdout=said, env=PLAIN) as outside:
        try:
            children = Path(f"/proc/{outside.pid}/task/{outside.pid}/children")
            made = Machine(int(_until(lambda: outside.poll() is None and children.read_text(), _BOOT_S)))
            _until(lambda: made.path("/run/systemd/private").exists(), _BOOT_S)
            _until(lambda: made.systemctl("is-active", "test.target", check=False).returncode == 0, _BOOT_S)
        except (AssertionError, OSError):
            outside.kill()
            pytest.skip(f"no systemd boots here: {log.read_text().strip()[-300:]}")
        try:
            made.path("/run/systemd/system/emulated.service").write_text(EMULATED)
            made.systemctl("daemon-reload")
            yield made
        finally:
            outside.kill()
            outside.wait()
            _until(lambda: "populated 0" in (group / "cgroup.events").read_text())
            for child in sorted(group.glob("**/"), reverse=True):
                child.rmdir()


@pytest.fixture
def polecal(machine):
    """The machine with devices that stream, polecal configured for them and not started, an empty journal."""
    machine.configure()
    machine.mark()
    machine.systemctl("start", "emulated")
    _until(machine.path("/run/emulated/span").is_symlink)
    yield machine
    machine.systemctl("stop", "polecal", "emulated", check=False)
    machine.systemctl("reset-failed", "polecal", check=False)
    shutil.rmtree(machine.path("/run/systemd/system/polecal.service.d"), ignore_errors=True)
    machine.systemctl("daemon-reload")
