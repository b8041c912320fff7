"""`armlab completion`: a script for the shell."""

from __future__ import annotations

from typing import Literal


def completion(shell: Literal["bash", "fish", "zsh"]) -> None:
    """Print a script that lets a shell complete commands, options and their values; install it with one line.

    - bash: armlab completion bash > ~/.local/share/bash-completion/completions/armlab
    - zsh: armlab completion zsh > DIR/_armlab, where DIR is a folder of $fpath
    - fish: armlab completion fish > ~/.config/fish/completions/armlab.fish

    Parameters
    ----------
    shell : str
        Which one.
    """
    from armlab.cli import build_app
    from armlab.cli.support.output import result

    result(build_app().generate_completion(shell=shell))
