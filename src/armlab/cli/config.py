"""``armlab config``: the settings in force and their origins. ``armlab completion``: a script for the shell."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from cyclopts import App

from armlab.cli import build_app
from armlab.cli.support.output import aligned, print_json, result

config = App(name="config", help="Show settings: of files, of the environment, of a cell. Writes nothing.")


@config.command(help_epilogue="Example: armlab config show --config cell.toml --origin")
def show(*, config: Path | None = None, origin: bool = False, json: bool = False) -> None:
    """Show every setting, and of a cell every value.

    A setting is taken from the first that has it: an option of a command, a variable of the environment such as
    ARMLAB_SPEED, armlab.toml in this folder, armlab/armlab.toml in ~/.config (or in XDG_CONFIG_HOME), the default.

    Parameters:
        config: The cell, a TOML file; the one of the settings when not given.
        origin: Also show where each value came from.
        json: Print JSON for scripts: name, value, origin.
    """
    from armlab.bridge.cell import cell_values
    from armlab.cli.support.settings import load_settings, read_text

    told = load_settings()
    rows: list[tuple[str, Any, str]] = [
        (name, getattr(told.settings, name), told.origins[name]) for name in told.settings.__struct_fields__
    ]
    if config is not None:
        rows = [row if row[0] != "cell" else ("cell", str(config), "--config") for row in rows]
    elif told.settings.cell is not None:
        config = Path(told.settings.cell)
    if config is not None:
        found = cell_values(read_text(config, "a cell"), str(config))
        rows += [(f"cell.{place}", value, str(config) if given else "default") for place, value, given in found]
    if json:
        print_json([{"name": name, "value": value, "origin": where} for name, value, where in rows])
        return
    shown = [(name, _written(value), where) for name, value, where in rows]
    result(aligned([("setting", "value", "from"), *shown] if origin else [row[:2] for row in shown]))


def _written(value: Any) -> str:
    """Return a value as it would stand in TOML; - for none."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list | tuple):
        return f"[{', '.join(_written(one) for one in value)}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{name} = {_written(one)}' for name, one in value.items())}}}"
    return str(value)


def completion(shell: Literal["bash", "fish", "zsh"]) -> None:
    """Print a script that lets a shell complete commands, options and their values; install it with one line.

    - bash: armlab completion bash > ~/.local/share/bash-completion/completions/armlab
    - zsh: armlab completion zsh > DIR/_armlab, where DIR is a folder of $fpath
    - fish: armlab completion fish > ~/.config/fish/completions/armlab.fish

    Parameters:
        shell: Which one.
    """
    result(build_app().generate_completion(shell=shell))
