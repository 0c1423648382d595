"""Are there such quantities? The table and the figure may ask for any; what there is, runs tell."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from stereophd.config.errors import nearest
from stereophd.errors import InputError
from stereophd.experiments.engine.base import Series
from stereophd.experiments.engine.summary import summarise, with_windows

if TYPE_CHECKING:
    from stereophd.config.loading import LoadedConfig


class QuantityCheck:
    """Says that a quantity does not exist as soon as every method has one run in every case, not after all runs.

    Parameters
    ----------
    loaded : LoadedConfig
        The experiment.
    cells : iterable of tuple
        Names of method and case of everything that is run.
    """

    def __init__(self, loaded: LoadedConfig, cells: Iterable[tuple[str, str]]) -> None:
        settings = loaded.config.experiment
        assert settings is not None
        self._path, self._windows = loaded.path, settings.windows
        self._wanted = {
            "experiment.table": settings.table or (),
            "experiment.figure.quantities": settings.figure.quantities or (),
        }
        self._left = set(cells)
        self._known: dict[str, None] = {}

    def see(self, method: str, case: str, series: Sequence[Series]) -> None:
        """Take note of what one run gave.

        Raises
        ------
        InputError
            This was the last first run, and none gave what the table or the figure asks for.
        """
        if (method, case) not in self._left:
            return
        self._left.remove((method, case))
        summaries = summarise([with_windows(series, self._windows)], [])
        self._known |= dict.fromkeys(one.quantity for one in summaries)
        if self._left:
            return
        for key, names in self._wanted.items():
            for name in names:
                if name not in self._known:
                    raise InputError(f"{self._path}: {key}: unknown quantity {name}{nearest(name, self._known)}")
