"""What one measurement of a field holds, and how its points grow and are checked, wherever they came from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from core.arrays import Bool, Float
from core.cameras.stereo import StereoPair
from core.field.checks.edges import clear_of_edges
from core.field.checks.gates import apply_gates
from core.field.checks.patch_choice import advise, choose_patch
from core.field.checks.plane_error import plane_error
from core.field.checks.residual_test import SigmaLimits
from core.field.growth.waves import Attempts, fit_in_batches, grow
from core.field.points.fitter import Fitter
from core.field.points.images import MeasureImage, different, refuse_stale, same_size
from core.field.points.patch import UsedPatch, asked_for
from core.field.points.result import Field
from core.field.region.region import PointGrid, check_region
from core.field.region.visibility import sight_of
from core.field.settings import MeasureOptions
from core.matching.image import ImageData
from core.progress import CancelToken, Progress, no_progress
from core.status import PointStatus

Image = ArrayLike | ImageData | MeasureImage

SAMPLE_FAR_PX = 3.0


class Growing:
    """Images and points of one computation; points that stand grow into others and are checked."""

    def __init__(
        self,
        pair: StereoPair,
        ref1: Image,
        ref2: Image,
        cur1: Image | None,
        cur2: Image | None,
        grid: PointGrid,
        options: MeasureOptions | None,
        progress: Progress | None,
        cancel: CancelToken | None,
    ) -> None:
        self.options = options or MeasureOptions()
        self.pair, self.grid, self.cancel = pair, grid, cancel
        self.progress: Progress = progress or no_progress
        self.ref1, self.ref2 = MeasureImage(ref1, "camera 1's image"), MeasureImage(ref2, "camera 2's image")
        self.cur1 = None if cur1 is None else MeasureImage(cur1, "camera 1's image at t")
        self.cur2 = None if cur2 is None else MeasureImage(cur2, "camera 2's image at t")
        self.sight = sight_of(grid, self.options.subset_px)
        if self.sight is not None:
            self.grid = grid = replace(grid, allowed=grid.allowed & self.sight.enough)
        self.fits_image = check_region(grid, image_shape=self.ref1.shape, subset_px=self.options.subset_px)
        if self.cur1 is None or self.cur2 is None:
            self.ref1.refuse_blank(grid.extent_px)
            self.ref2.refuse_blank()
            different(self.ref1, self.ref2)
        else:
            same_size(self.ref1, self.cur1)
            same_size(self.ref2, self.cur2)
            self.cur1.refuse_blank()
            self.cur2.refuse_blank()
            different(self.cur1, self.cur2)
            refuse_stale(self.ref1, self.ref2, self.cur1, self.cur2)
        self.blur = self.options.blur
        if self.blur is not None:
            self.fits_image = clear_of_edges(self.fits_image, grid, self.ref1.shape, self.options.subset_px, self.blur)
        self.xy_px = grid.xy_px.reshape(-1, 2)
        self.rays = pair.cam1.rays_cam(self.xy_px).xyz_mm
        self.usable: Bool = self.fits_image.ravel() & np.isfinite(self.rays).all(axis=1)
        kind, (noise1, noise2) = self.options.interpolation, self.options.noise
        self.fitter = Fitter(
            pair=pair,
            ref1=self.ref1.prepared(kind, noise1, self.blur),
            ref2=self.ref2.prepared(kind, noise2, self.blur),
            cur1=None if self.cur1 is None else self.cur1.prepared(kind, noise1, self.blur),
            cur2=None if self.cur2 is None else self.cur2.prepared(kind, noise2, self.blur),
            options=self.options.match_options(),
            least_zncc=self.options.least_zncc,
            sight=self.sight,
        )
        asked = self.options.patch
        plane: UsedPatch = "plane" if cur1 is None else self.fitter.options.patch
        self.patch = asked_for("curved" if asked == "curved" else plane, asked)
        self.points = self.fitter.empty(len(self.xy_px))
        self.known_w: Float | None = None
        self.hoped_for = self.usable  # where new seeds are worth their time
        self.checked = False  # whether every point that stands went through the gates
        self.attempts = Attempts.on(grid.shape, self.sight)
        compared = None if self.blur is None else self.fitter.ref1
        self.texture = self.ref1.subset_variance(self.xy_px, self.options.subset_px, compared)
        if self.sight is not None:
            pixels = self.ref1.pixels if compared is None else compared.pixels
            self.texture = self.sight.correct_variance(self.texture, pixels)

    def _settle_patch(self) -> None:
        """Say what plane patches err by here; where auto was asked for, go over to curved ones if that pays."""
        told = None
        if self.fitter.terms == 3:
            told = plane_error(
                self.points,
                shape=self.grid.shape,
                rays=self.rays,
                step_px=self.grid.step_px,
                subset_px=self.options.subset_px,
            )
        if self.options.patch != "auto":
            self.patch = advise(self.patch, told)
        elif not self.patch.kept:
            self.patch = choose_patch(self.fitter, self.points, self.xy_px, told)
            if self.patch.patch == "curved":
                self._refit_curved()
                self._fill()

    def _fill(self) -> None:
        """Grow, check, and grow into what the checks emptied."""
        for _ in range(3):
            if self._grow() == 0 and self.checked:
                break
            self.check()

    def keep_patch(self, previous: Field | None) -> None:
        """Where a sequence went over to curved patches by itself, it stays with them."""
        choice = None if previous is None or not previous.has_motion else previous.patch
        if self.options.patch == "auto" and choice is not None and choice.patch == "curved":
            self.patch = choice.for_next_step()

    def _refit_curved(self) -> None:
        """Measure the points that stand anew with curved patches; the others keep their status and are tried again."""
        flat = self.points
        index = np.flatnonzero(flat.ok)
        self.fitter = self.fitter.curved()
        self.points = self.fitter.empty(len(flat.status))
        self.points.status[:] = flat.status
        self._forget_attempts()
        G = None if self.fitter.comparisons == 1 else flat.G[index]
        fit_in_batches(
            self.fitter, self.points, index, self.xy_px, flat.w[index], G, far_px=SAMPLE_FAR_PX, cancel=self.cancel
        )
        self.checked = False

    def _unreached(self) -> float:
        """Share of the usable points that nothing reached; those lost in an earlier step do not count again."""
        untouched = self.hoped_for & (self.points.status == PointStatus.NOT_SEEDED)
        return float(untouched.sum()) / max(int(self.usable.sum()), 1)

    def _forget_attempts(self) -> None:
        """Let growth try every point anew; those lost in an earlier step once only, should they have come back."""
        self.attempts = Attempts.on(self.grid.shape, self.sight)
        self.attempts.left[self.usable & ~self.hoped_for] = 1

    def _grow(self) -> int:
        added = grow(
            self.fitter,
            self.points,
            attempts=self.attempts,
            xy_px=self.xy_px,
            rays=self.rays,
            usable=self.usable,
            progress=self.progress,
            cancel=self.cancel,
        )
        self.checked = self.checked and added == 0
        return added

    @property
    def sigma_limits(self) -> SigmaLimits:
        """How far a point may scatter whose residuals are not noise."""
        gates = self.options.gates
        return SigmaLimits(motion_px=gates.largest_sigma_px, depth_px=gates.largest_depth_sigma_px)

    def check(self) -> None:
        """Have every point that stands checked; those that fail are refused."""
        apply_gates(
            self.points,
            pair=self.pair,
            shape=self.grid.shape,
            xy_px=self.xy_px,
            rays=self.rays,
            texture=self.texture,
            options=self.options.gates,
            sight=self.sight,
        )
        self.checked = True
