"""The command line: help of every command, texts from outside, and no code of the working directory."""

from __future__ import annotations

import argparse
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from omnid.cli import COMMANDS, command_at, main, parser_of
from omnid.config import Config
from omnid.plain_text import MAX_CHARACTERS, one_line, plain
from omnid.settings import value_at
from tests.omnid.commands.test_batch import short_log
from tests.ports import free_port

EXAMPLES = {words: command_at(place).examples for words, (place, _) in COMMANDS.items()}


def test_a_call_without_words_shows_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    assert "install-service" in capsys.readouterr().out


@pytest.mark.parametrize("words", COMMANDS)
def test_help_has_a_description_and_examples_to_copy(
    words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    with pytest.raises(SystemExit):
        main([*words.split(), "--help"])
    text, _, examples = capsys.readouterr().out.partition("\nexamples:\n")
    assert examples.splitlines() == [f"  omnid {example}" for example in EXAMPLES[words]] != []
    _, _, below_usage = text.partition("\n\n")
    assert [line for line in below_usage.splitlines() if len(line) > 60 and " " in line.strip()] == []
    assert ".\n" in below_usage


@pytest.mark.parametrize("example", [example for examples in EXAMPLES.values() for example in examples])
def test_every_example_is_accepted(example: str) -> None:
    words = shlex.split(example.partition(" > ")[0])
    assert parser_of(words).parse_args(words).command


@pytest.mark.parametrize("words", COMMANDS)
def test_options_stand_for_settings_that_exist(words: str) -> None:
    parser = argparse.ArgumentParser()
    command_at(COMMANDS[words][0]).add_to(parser)
    for action in parser._actions:
        if setting := getattr(action, "setting", None):
            value_at(Config(), setting)
        assert "  " not in (action.help or "") and "[" not in "".join(action.choices or ())


def test_the_shell_completes_commands_and_options(tmp_path: Path) -> None:
    def completions(line: str) -> set[str]:
        found = tmp_path / "found"
        environment = {
            **os.environ,
            "_ARGCOMPLETE": "1",
            "_ARGCOMPLETE_IFS": "\n",
            "COMP_LINE": line,
            "COMP_POINT": str(len(line)),
            "COMP_TYPE": "9",
            "_ARGCOMPLETE_STDOUT_FILENAME": str(found),
        }
        subprocess.run([sys.executable, "-m", "omnid"], env=environment, check=True)
        return {word.strip() for word in found.read_text().splitlines()}

    assert completions("omnid ") >= {"run", "stop"}
    assert completions("omnid re") >= {"replay", "report", "record"}
    assert {"--rig", "--tum", "--plan"} <= completions("omnid replay --")
    assert completions("omnid calibrate dr") == {"drive"}


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            ["replay", "x", "--metod", "paper"],
            "unrecognized arguments: --metod paper; see omnid --help",
        ),
        (
            ["calibrate", "rig", "a", "-o", "b", "--expected-baseline-mm", "-4"],
            "argument --expected-baseline-mm: expected 0.001 or more, found '-4'; see omnid calibrate rig --help",
        ),
    ],
)
def test_a_wrong_word_is_named_with_what_was_expected(
    words: list[str], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2 and capsys.readouterr().err == f"omnid: {line}\n"


def test_a_signal_while_modules_are_loaded_ends_the_program_quietly() -> None:
    script = (
        "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\nfrom omnid import cli\n"
        "cli.import_module = lambda _: signal.raise_signal(signal.SIGINT)\ncli.main(['replay', 'log.mcap'])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b[2J\n\t\0\x9b", r"\x1b[2J\n\t\x00\x9b"),
        (os.fsdecode(b"a\xff\x80"), r"a\udcff\udc80"),
        ("\ud800\u202e\u2028", r"\ud800\u202e\u2028"),
    ],
)
def test_unprintable_characters_are_escaped(text: str, shown: str) -> None:
    assert plain(text) == shown and shown.isprintable()


def test_a_message_is_one_line_of_limited_length() -> None:
    assert one_line(ValueError(" two\r\nlines \x07 ")) == r"two lines \x07"
    assert len(plain("\0" * 1000)) == len(one_line("x" * 1000)) == MAX_CHARACTERS and plain("abc", 2) == "ab"


ROOT = Path(__file__).parents[2]
# Modules of the program, of its packages and of Python that a file in the working directory may pretend to be.
FOREIGN = ("omnid", "drivers", "numpy", "cv2", "zenoh", "json", "pickle", "html", "rerun_cli", "sitecustomize")


def test_no_module_of_the_working_directory_is_run(tmp_path: Path) -> None:
    """Without Python's own folder of the program, as the installed one; with a controller, which is another process."""
    folder, marker = tmp_path / "hostile", tmp_path / "marker"
    folder.mkdir()
    for name in FOREIGN:
        (folder / f"{name}.py").write_text(f"open({str(marker)!r}, 'a').write({name!r} + ' ')\nraise SystemExit(99)\n")
    log, recordings = short_log(tmp_path / "log.mcap"), tmp_path / "recordings"
    settings = ("record.enabled=true", f'record.folder="{recordings}"', f'bus.listen=["tcp/127.0.0.1:{free_port()}"]')
    words = ["-m", "omnid", "run", "--log", str(log), "--once", "--motor", "simulated"]
    words += [word for setting in settings for word in ("--set", setting)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-P", *words], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0 and not marker.exists(), done.stderr
    assert list(recordings.iterdir())
