"""The results of a folder in a window of their own: sorted by any column, each row opens."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import viser

from flows.viewer.folder import ResultTable

MOST_BUTTONS = 100


class Results:
    """The table of one browser; a click on a row's number calls `open_run` with the run's name."""

    def __init__(self, gui: viser.GuiApi, table: ResultTable, open_run: Callable[[str], Any]) -> None:
        self.table, self._open_run = table, open_run
        self._window = gui.add_panel()
        self._window.float(x=12, y=-12, width=620, height=260)
        with self._window.add_tab("Results"):
            self._sort = gui.add_dropdown("Sort by", table.columns)
            self._rising = gui.add_checkbox("Rising", True)
            self._rows = gui.add_html("")
            self._buttons: Any = gui.add_button_group("Open row", ("1",))
        sorting: list[Any] = [self._sort, self._rising]
        for control in sorting:
            control.on_update(lambda _: self.show(self.table))
        self._buttons.on_click(lambda _: self._open(int(self._buttons.value)))
        self.show(table)

    def show(self, table: ResultTable) -> None:
        """Show this table, sorted as it is chosen."""
        self.table = table
        if tuple(self._sort.options) != table.columns:
            self._sort.options = table.columns
        self._rows.content = table.html(self._sort.value, self._rising.value)
        self._buttons.options = tuple(str(i + 1) for i in range(min(len(table.rows), MOST_BUTTONS)))

    def _open(self, number: int) -> None:
        order = self.table.order(self._sort.value, self._rising.value)
        self._open_run(self.table.runs[order[number - 1]])
