"""Progress of jobs as a bar, in a terminal and in a notebook."""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Callable, Iterator

from stereorig.core.errors import StateError
from stereorig.server.api.models import JobReply

#: called with a job whenever it was asked for
OnProgress = Callable[[JobReply], None]
#: True: a bar; False: nothing; None: a bar if rich is installed and the output is shown; or a function of the caller's
Progress = bool | None | OnProgress


@contextlib.contextmanager
def shown(progress: Progress, title: str) -> Iterator[OnProgress | None]:
    """Yield a function that takes a job's documents until it has ended; None if no progress is shown.

    Raises
    ------
    StateError
        ``progress_unavailable`` if a bar is asked for and rich is not installed.
    """
    if callable(progress):
        yield progress
        return
    if progress is False or (progress is None and importlib.util.find_spec("rich") is None):
        yield None
        return
    try:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as Bars
    except ImportError as error:
        raise StateError(
            "A progress bar is asked for, and rich is not installed.",
            code="progress_unavailable",
            remedy="pip install 'stereorig[progress]', or give progress=False.",
        ) from error
    console = Console(stderr=True)
    if progress is None and not (console.is_terminal or console.is_jupyter):
        yield None
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Bars(*columns, console=console) as bars:
        task = bars.add_task(title, total=None)

        def update(job: JobReply) -> None:
            at = job.progress
            text = f"{title}: {at.phase}" if job.state == "running" else f"{title}: {job.state}"
            bars.update(task, description=text, completed=at.done, total=at.total or None)

        yield update
