"""The channels that the rig file names, read as lines while a test is measured live."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict

from core.errors import InputError
from drivers.channels.lines import ChannelLine, LineSource
from server.config.rig_file import ChannelSection
from server.workflows.live.series import LiveSeries


class ReadChannels:
    """Reads channels into a live measurement's series, each stamped at its arrival on the host's monotonic clock.

    Parameters
    ----------
    sections
        Of the rig file: no request names an address.
    series
        Gets the readings.
    """

    def __init__(self, sections: Sequence[ChannelSection], series: LiveSeries) -> None:
        self._series = series
        self._units = {section.name: section.unit for section in sections}
        self._lines = {
            section.name: ChannelLine(LineSource(**section.model_dump(exclude={"unit"})), self._put_of(section.name))
            for section in sections
        }

    def _put_of(self, name: str) -> Callable[[float, float], None]:
        def put(time_s: float, value: float) -> None:
            self._series.put([(time_s, {name: value})])

        return put

    def start(self) -> None:
        """Begin to read."""
        for line in self._lines.values():
            line.start()

    def stop(self) -> None:
        """End it."""
        for line in self._lines.values():
            line.stop()

    def refuse_posted(self, names: set[str]) -> None:
        """Raise an error for names of channels that are read.

        Raises
        ------
        InputError
            ``channel_is_read``.
        """
        both = sorted(names & self._lines.keys())
        if both:
            raise InputError(
                f"The channel {both[0]} is read by the service.",
                code="channel_is_read",
                remedy="Post readings under another name; the rig file's [[live.channels]] has those that are read.",
            )

    def document(self) -> dict[str, dict[str, object]]:
        """Return of each channel its unit and the state of its line."""
        return {name: {"unit": self._units[name], "line": asdict(line.state)} for name, line in self._lines.items()}
