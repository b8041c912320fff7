"""Figures as bytes, for pages that carry everything inside, and in windows."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING

from armlab.errors import ConfigError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["png", "show"]


def png(drawn: Figure | Axes, dpi: int = 110) -> bytes:
    """Return what was drawn as a PNG file, and close its figure.

    Parameters
    ----------
    drawn : Figure or Axes of a function of this package.
    dpi : dots per inch.
    """
    import matplotlib.pyplot as plt
    from matplotlib.figure import Figure

    figure = drawn if isinstance(drawn, Figure) else drawn.get_figure(root=True)
    memory = BytesIO()
    if figure is not None:
        figure.savefig(memory, format="png", dpi=dpi)
        plt.close(figure)
    return memory.getvalue()


def show() -> None:
    """Open a window with each figure that was drawn, and wait until all are closed.

    Raises
    ------
    ConfigError : there is no screen, or matplotlib was told to use none.
    """
    import matplotlib.pyplot as plt
    from matplotlib.backends.registry import BackendFilter, backend_registry

    if plt.get_backend().lower() in backend_registry.list_builtin(BackendFilter.NON_INTERACTIVE):
        raise ConfigError(
            f"Expected a screen for the figure, got none (matplotlib draws by {plt.get_backend()}). Open its file."
        )
    plt.show()
