"""Pairing by frame number for cameras on one trigger line whose counters did not start together.

Both cameras count their frames, but one may have been armed a pulse earlier. The first two frames that began within
half a period fix the offset of the numbers; from then on numbers decide, and late or jittering arrivals have no effect.
A camera that missed a pulse does not count it: from there its numbers differ by one, which shows as a skew of a whole
period. Such a pair is refused, and the numbers are aligned again.
"""

from __future__ import annotations

from dataclasses import fields

from stereorig.core.names import CameraName
from stereorig.drivers.acquisition.pairing import NumberPairing, Pair, PairingAccount, TimePairing
from stereorig.drivers.acquisition.simultaneity import Simultaneity, simultaneity
from stereorig.drivers.cameras.protocol import Frame


class AlignedPairing:
    """Frame numbers, aligned by time.

    Parameters
    ----------
    period_ms
        Period of the pulses.
    max_skew_ms, common_clock, depth
        As in `stereorig.drivers.acquisition.pairing.NumberPairing`; more than half a period is never accepted.
    """

    def __init__(
        self, *, period_ms: float, max_skew_ms: float, common_clock: bool | Simultaneity, depth: int = 8
    ) -> None:
        self._period_ms, self._depth = period_ms, depth
        self._max_skew_ms = min(max_skew_ms, period_ms / 2)
        self._times = simultaneity(common_clock)
        self._earlier = PairingAccount()
        self._numbers: NumberPairing | None = None
        self._finder = self._new_finder()

    def _new_finder(self) -> TimePairing:
        return TimePairing(
            period_ms=self._period_ms, max_skew_ms=self._max_skew_ms, common_clock=self._times, depth=self._depth
        )

    @property
    def account(self) -> PairingAccount:
        """Counters of the closed pulses."""
        now = self._finder.account if self._numbers is None else self._numbers.account
        return _sum(self._earlier, now)

    def feed(self, cam: CameraName, frame: Frame) -> Pair | None:
        """Take a frame, complete or not, in the order of its camera; returns a pair when it makes one."""
        if self._numbers is None:
            pair = self._finder.feed(cam, frame)
            if pair is not None:
                self._earlier = _sum(self._earlier, self._finder.finish())
                self._numbers = NumberPairing(
                    by="frame",
                    max_skew_ms=self._max_skew_ms,
                    common_clock=self._times,
                    origin={"cam1": pair.cam1.sequence + 1, "cam2": pair.cam2.sequence + 1},
                    depth=self._depth,
                )
            return pair
        pair = self._numbers.feed(cam, frame)
        if pair is not None and abs(pair.skew_ms) > self._period_ms / 2:
            self._earlier = _sum(_sum(self._earlier, self._numbers.finish()), PairingAccount(slips=1))
            self._numbers = None
            self._finder = self._new_finder()
            return None  # two frames of two pulses: counted as paired and refused, and not delivered
        return pair

    def finish(self) -> PairingAccount:
        """Close all and return the counters of the pulses."""
        (self._finder if self._numbers is None else self._numbers).finish()
        return self.account


def _sum(one: PairingAccount, two: PairingAccount) -> PairingAccount:
    return PairingAccount(**{f.name: getattr(one, f.name) + getattr(two, f.name) for f in fields(PairingAccount)})
