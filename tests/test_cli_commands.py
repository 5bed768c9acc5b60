"""The list of commands: true to each of them, and told without loading them."""

import os
import re
import subprocess
import sys

import pytest

from torchsfm.cli.commands import COMMANDS, load

PROGRAM = ("-c", "import sys; sys.argv[0] = 'torchsfm'; from torchsfm.cli import main; main()")
COMPLETION = {"_TORCHSFM_COMPLETE": "complete_bash", "COMP_WORDS": "torchsfm rec", "COMP_CWORD": "1"}


def run(*words: str, **environment: str) -> tuple[str, bool]:
    """What a process of its own prints, and whether it loaded PyTorch."""
    command = [sys.executable, "-X", "importtime", *words]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | environment, check=True)
    return done.stdout, re.search(r"\| +torch$", done.stderr, re.MULTILINE) is not None


@pytest.mark.parametrize("name", COMMANDS)
def test_the_list_says_what_each_command_says_of_itself(name: str) -> None:
    command = load(name)
    assert command.name == name
    assert command.help.splitlines()[0] == COMMANDS[name][1]
    options = {word for parameter in command.params for word in parameter.opts}
    assert {"--quiet", "-q", "--json"} <= options, "each speaks to programs and to nobody"


@pytest.mark.parametrize("program", [PROGRAM, ("-m", "torchsfm")], ids=["script", "module"])
def test_help_and_version_are_told_without_pytorch(program: tuple[str, ...]) -> None:
    text, loaded = run(*program, "--help")
    assert not loaded
    for name in COMMANDS:
        assert re.search(rf"^\W*{name} ", text, re.MULTILINE)
    text, loaded = run(*program, "--version")
    assert not loaded
    assert re.fullmatch(r"torchsfm \d+\.\d+\.\d+\n", text)
    text, loaded = run(*program, "merge", "--help")
    assert loaded
    assert "--fixed-cameras" in text


def test_the_shell_completes_commands_without_pytorch_and_their_options_too() -> None:
    text, loaded = run(*PROGRAM, **COMPLETION)
    assert (text.split(), loaded) == (["reconstruct"], False)
    text, _ = run(*PROGRAM, **COMPLETION | {"COMP_WORDS": "torchsfm merge --fix", "COMP_CWORD": "2"})
    assert text.split() == ["--fixed-cameras"]
