"""Progress bars on standard error: the one object through which a stage shows how far it is."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NoReturn, TypeVar

from wbm.launch.stop import Stopped

T = TypeVar("T")


class Task:
    """One bar. Usable as a context manager; `update` is cheap enough for every step."""

    def __init__(self, bars: Any, description: str, total: float | None) -> None:
        self._bars = bars
        self._id = bars.add_task(description, total=total, fields="") if bars else None

    def update(self, n: float = 1, **fields: Any) -> None:
        """Advance by `n` and show `fields`, such as `loss=0.12`."""
        if self._bars:
            text = " ".join(f"{k}={v:.4g}" if isinstance(v, float) else f"{k}={v}" for k, v in fields.items())
            self._bars.update(self._id, advance=n, **({"fields": text} if fields else {}))

    def close(self) -> None:
        """Take the bar off the screen."""
        if self._bars:
            self._bars.remove_task(self._id)
            self._bars = None

    def __enter__(self) -> Task:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Progress:
    """Bars for the work of a stage; silent when `enabled` is false.

    On a terminal the bars move; in a log, each message is one line.

    Attributes:
        stopping: whether the scheduler asked the run to stop at its next safe point.
    """

    def __init__(self, enabled: bool = True) -> None:
        self.stopping: Callable[[], bool] = lambda: False
        self._enabled = enabled
        self._bars: Any = None

    def __enter__(self) -> Progress:
        if self._enabled and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, SpinnerColumn, TextColumn, TimeRemainingColumn
            from rich.progress import Progress as Bars

            columns = (
                SpinnerColumn(),
                TextColumn("{task.description}"),
                BarColumn(bar_width=30),
                MofNCompleteColumn(),
                TimeRemainingColumn(compact=True, elapsed_when_finished=True),
                TextColumn("[dim]{task.fields[fields]}"),
            )
            self._bars = Bars(*columns, console=Console(stderr=True), transient=True, refresh_per_second=5)
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bars:
            self._bars.stop()
            self._bars = None

    def task(self, description: str, total: float | None = None) -> Task:
        """Open a bar that the caller advances."""
        if self._enabled and not self._bars:
            self.message(f"  {description}" + (f" ({total:g})" if total is not None else ""))
        return Task(self._bars, description, total)

    def track(self, iterable: Iterable[T], description: str, total: float | None = None) -> Iterator[T]:
        """Iterate with a bar; `total` defaults to the length of the iterable."""
        if total is None and hasattr(iterable, "__len__"):
            total = len(iterable)  # pyright: ignore[reportArgumentType]
        with self.task(description, total) as task:
            for item in iterable:
                yield item
                task.update()

    def safe_point(self) -> None:
        """A stage calls this where all that it has done is on disk.

        Raises:
            Stopped: the run was asked to stop.
        """
        if self.stopping():
            self.stop()

    def stop(self) -> NoReturn:
        """End the run here; what it has done is kept."""
        raise Stopped("asked to stop")

    def message(self, text: str) -> None:
        """Print a line on standard error, above the bars."""
        if not self._enabled:
            return
        if self._bars:
            self._bars.console.print(text, markup=False, highlight=False)
        else:
            sys.stderr.write(text + "\n")
            sys.stderr.flush()
