"""Help of commands, wrapped to the terminal."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cyclopts.help import HelpPanel
    from rich.console import Console, ConsoleOptions


_BREAK_IN_PARAGRAPH = re.compile(r"(?<=\S)[ \t]*\n(?![\s*-])")


def unwrapped(text: str) -> str:
    """Return a text whose paragraphs are one line each; empty lines, lists and indented lines stay."""
    return _BREAK_IN_PARAGRAPH.sub(" ", text)


class WrappedHelp:
    """The default look of cyclopts for texts that keep the line breaks of their docstring."""

    def render_usage(self, console: Console, options: ConsoleOptions, usage: Any) -> None:
        """Print the line of usage."""
        _default().render_usage(console, options, usage)

    def render_description(self, console: Console, options: ConsoleOptions, description: Any) -> None:
        """Print what the command does."""
        _default().render_description(console, options, _wrapped(description))

    def __call__(self, console: Console, options: ConsoleOptions, panel: HelpPanel) -> None:
        """Print a panel of commands or parameters."""
        from attrs import evolve

        entries = [evolve(entry, description=_wrapped(entry.description)) for entry in panel.entries]
        _default()(console, options, panel.copy(entries=entries))


def _default() -> Any:
    from cyclopts.help import DefaultFormatter

    return DefaultFormatter()


def _wrapped(shown: Any) -> Any:
    """Unwrap the text of something that is shown; it is made anew for each print."""
    from rich.text import Text

    text = getattr(shown, "primary_renderable", None)
    if isinstance(text, Text):
        shown.primary_renderable = Text(unwrapped(text.plain), end=text.end)
    return shown
