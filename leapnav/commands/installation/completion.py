"""`leapnav completion`: scripts that complete commands, options and their choices in a shell."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from typing import Literal

import tyro


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
        subprocess.run([sys.executable, "-m", "leapnav", "--tyro-print-completion", self.shell], check=True)
        return 0
