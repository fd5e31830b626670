"""The manual says all that the programs and the configuration know, and completion offers it."""

import io
import re
import shutil
import subprocess
import sys

import pytest
import structlog

from polecal.daemon import field, manual, service
from polecal.daemon.completion import names, script
from polecal.daemon.config import Config
from polecal.daemon.control import Code, ControlServer

PAGES = manual.pages()


def plain(name):
    """A page's text without its formatting."""
    return re.sub(r"\\f.|\\&", "", PAGES[name]).replace("\\-", "-").replace("\\e", "\\")


def options(parser):
    return [option for action in parser._actions for option in action.option_strings]


def test_every_verb_and_option_of_the_operators_command_is_in_its_page():
    text = plain("polecal-field.1")
    parser = field.make_parser()
    verbs = manual.verbs(parser)
    assert {"start", "status", "wait", "stop", "result", "report", "replay", "doctor", "decode"} <= set(verbs)
    for option in options(parser):
        assert re.search(rf"^.*{option}\b", text, re.MULTILINE), option
    for name, verb in verbs.items():
        section = text.split(f".SS {name}\n")[1].split("\n.S")[0]
        assert verb.description in section
        for action in verb._actions:
            told = action.option_strings or [str(action.metavar or action.dest)]
            assert any(each in section for each in told), (name, action)


def test_nothing_is_listed_without_a_word_about_it():
    for name, page in PAGES.items():
        for item, said in re.findall(r"^\.TP\n(.*)\n(.*)", page, re.MULTILINE):
            assert re.search(r"[a-z]{3}", said), (name, item)
            assert not said.startswith("None"), (name, item)


def test_every_exit_code_and_the_daemons_options_are_told():
    for name in ("polecal-field.1", "polecald.8"):
        for code in (0, *Code):
            assert f".TP\n{int(code)}\n" in plain(name)
    for option in options(service.make_parser()):
        assert option in plain("polecald.8")


def test_every_key_of_the_configuration_is_told_with_its_default():
    text = plain("polecal.yaml.5")
    keys = list(manual.keys(Config))
    assert len(keys) > 50
    for path, about, below in keys:
        assert f".TP\n{path}\n" in text
        assert about.description, path
        if below is None and not about.is_required() and isinstance(about.default, int | float):
            assert re.search(rf"\n{re.escape(path)}\n.*default {about.default}\)", text), path
    assert "lasers[].mount.x_m" in text
    assert "default front)" in text
    assert "above 0, at most 1" in text


def test_the_pages_are_formatted_without_a_warning(tmp_path):
    groff = shutil.which("groff")
    if groff is None:
        pytest.skip("groff is not installed")
    assert manual.main(["--out", str(tmp_path)]) == 0
    files = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    assert [file.relative_to(tmp_path).parts for file in files] == [
        ("man1", "polecal-field.1"),
        ("man5", "polecal.yaml.5"),
        ("man8", "polecald.8"),
    ]
    for path in files:
        done = subprocess.run(
            [groff, "-ww", "-K", "utf8", "-man", "-T", "utf8", "-P", "-cbou", path],
            check=True,
            capture_output=True,
        )
        assert done.stderr == b"", done.stderr.decode()
        assert b"EXIT STATUS" in done.stdout or b"KEYS" in done.stdout
    if mandoc := shutil.which("mandoc"):
        subprocess.run([mandoc, "-T", "lint", "-W", "warning", *files], check=True)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_is_a_script_that_the_shell_takes(shell, tmp_path):
    path = tmp_path / "completion"
    path.write_text(script(field.make_parser(), shell))
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    subprocess.run([shell, "-n", path], check=True, timeout=30)


BASH = r"""
eval "$(%s -m polecal.daemon.field completion bash)"
complete_line() {
    COMP_WORDS=($1) COMP_LINE=$1 COMP_POINT=${#1} COMPREPLY=()
    [[ $1 == *' ' ]] && COMP_WORDS+=("")
    COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
    function=$(complete -p polecal-field | sed 's/.*-F \([^ ]*\).*/\1/')
    $function polecal-field "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD - 1]}"
    echo "${COMPREPLY[@]}"
}
polecal-field() { echo 20261122T031500Z-yard 20261122T041500Z-road; }
complete_line "polecal-field st"
complete_line "polecal-field status --w"
complete_line "polecal-field result --format u"
complete_line "polecal-field result 20261122T03"
"""


def test_bash_completes_verbs_options_values_and_the_names_of_sessions():
    done = subprocess.run(
        ["bash", "--norc", "-c", BASH % sys.executable],
        check=False,
        capture_output=True,
        text=True,
        timeout=60,
    )
    verbs, option, value, session = done.stdout.splitlines()
    assert set(verbs.split()) >= {"start", "status", "stop"}
    assert option.split() == ["--watch"]
    assert value.split() == ["urdf"]
    assert session.split() == ["20261122T031500Z-yard"]


def test_names_come_from_the_daemon_and_without_one_there_are_none(tmp_path, capsys):
    structlog.configure(logger_factory=structlog.WriteLoggerFactory(io.StringIO()))

    class Shelf:
        def handle(self, request):
            if request["class"] == "SESSIONS":
                return {"class": "SESSIONS", "sessions": [{"session": "s1"}, {"session": "s2"}]}
            return {"class": "PASSES", "passes": [{"name": "front-001"}]}

    socket = tmp_path / "control.sock"
    assert names(socket, "sessions") == []
    with ControlServer(socket, Shelf()):
        assert names(socket, "sessions") == ["s1", "s2"]
        assert field.main(["--socket", str(socket), "completion", "passes"]) == 0
    assert capsys.readouterr().out == "front-001\n"
    structlog.reset_defaults()
