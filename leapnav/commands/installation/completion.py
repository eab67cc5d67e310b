"""`leapnav completion`: scripts that complete commands, options and their choices in a shell."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import dataclass
from typing import Literal

import tyro

# tyro's scripts contain a description of all options. If an option accepts other words besides its choices, only its
# help text contains the choices; the other words are files.
_OPEN_CHOICE = re.compile(r"('description': '\{([^}']*)\}\|STR[^']*', 'type': )'path'")
_NO_MATCH = "                                return completions\n"
_FILES = '                                return completions or ["__TYRO_COMPLETE_FILES__"]\n'


@dataclass(frozen=True)
class Completion:
    """Print a script that completes commands, options and choices, to be saved where the shell looks for it.

    bash: ~/.local/share/bash-completion/completions/leapnav; zsh: _leapnav in a directory of $fpath; fish:
    ~/.config/fish/completions/leapnav.fish.
    """

    shell: tyro.conf.Positional[Literal["bash", "zsh", "fish"]]
    """Shell."""

    def run(self) -> int:
        """Print the script."""
        # Another process, because the command line imports this module.
        command = [sys.executable, "-m", "leapnav", "--tyro-print-completion", self.shell]
        script = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        print(complete_choices(script), end="")
        return 0


def complete_choices(script: str) -> str:
    """Return a completion script of tyro that also completes the choices of options that accept other words."""

    def with_choices(found: re.Match[str]) -> str:
        return f"{found[1]}'choice', 'choices': {found[2].split(',')!r}"

    return _OPEN_CHOICE.sub(with_choices, script).replace(_NO_MATCH, _FILES)
