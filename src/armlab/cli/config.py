"""``armlab config``: effective settings and their origins. ``armlab completion``: shell completion script."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from cyclopts import App

from armlab.cli import build_app
from armlab.cli.support.output import aligned, print_json, result

config: App = App(name="config", help="Show the settings from files, the environment and the cell. Writes nothing.")


@config.command(help_epilogue="Example: armlab config show --config cell.toml --origin")
def show(*, config: Path | None = None, origin: bool = False, json: bool = False) -> None:
    """Show all settings, and all values of a cell.

    In order of precedence, the sources of a setting are a command-line option, an environment variable such as
    ARMLAB_SPEED, armlab.toml in this folder, armlab/armlab.toml in ~/.config (or in XDG_CONFIG_HOME), and the default.

    Parameters:
        config: TOML file of the cell; default: from the settings.
        origin: Also show the source of each value.
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
    """Return a value in TOML notation, or "-" for None."""
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
    """Print a shell completion script for commands, options and values. To install it, run one of these lines:

    - bash: armlab completion bash > ~/.local/share/bash-completion/completions/armlab
    - zsh: armlab completion zsh > DIR/_armlab, where DIR is a folder of $fpath
    - fish: armlab completion fish > ~/.config/fish/completions/armlab.fish

    Parameters:
        shell: Name of the shell.
    """
    result(build_app().generate_completion(shell=shell))
