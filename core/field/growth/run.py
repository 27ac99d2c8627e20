"""One measurement of a field: seeds, growth, checks, a second growth into what the checks emptied, checks again."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.arrays import Bool, Float
from core.errors import SeedError
from core.field.checks.edges import refuse_near_edges
from core.field.checks.residual_test import judge
from core.field.checks.unreached import mark_outside
from core.field.growth.state import SAMPLE_FAR_PX, Growing
from core.field.growth.waves import fit_in_batches
from core.field.points.assemble import assemble
from core.field.points.features import Box
from core.field.points.fitter import PointFits
from core.field.points.images import features_of
from core.field.points.result import Field
from core.field.points.starts import Starts
from core.field.region.repeats import repeats
from core.field.seeding.predict import predict
from core.field.seeding.scattered_matches import (
    ScatteredMotion,
    ScatteredShape,
    scattered_motion,
    scattered_shape,
    stretched_motion,
)
from core.field.seeding.search_region import box_around, scales, seen_by_camera2
from core.field.seeding.seeds import (
    Seed,
    as_seeds,
    nearest_points,
    refine,
    search_motion,
    seeds_from_matches,
    spread,
    sweep_shape,
    swept_places,
)
from core.matching.fit import no_motion
from core.progress import raise_if_cancelled
from core.status import PointStatus

Seeds = Sequence[Seed | Sequence[float]] | NDArray[Any]

_FEWEST_MATCHES = 12
_SAMPLE_SHARE = 0.7
_REACH_STEPS = 2.0
_LEFT_OVER = 0.02


class Run(Growing):
    """One computation: the stages that put its first points down, and all of it in order."""

    @cached_property
    def repeating(self) -> Bool:
        """(n,) where the texture repeats itself, so that no start may be put there."""
        out = np.zeros(len(self.xy_px), bool)
        out[self.usable] = repeats(self.ref1.pixels, self.xy_px[self.usable], subset_px=self.options.subset_px)
        return out

    # seeds

    def seed_shape(self, seeds: Seeds | None) -> None:
        """Put the first points of a shape down."""
        self.progress("seeds", 0, 1)
        if seeds is not None:
            self._user_shape(as_seeds(seeds))
        elif self._match_seeds() == 0:
            self._swept_shape()
        self.progress("seeds", 1, 1)

    def seed_motion(self, shape: Field, previous: Field | None, seeds: Seeds | None) -> None:
        """Put the first points of a motion down: from the last step, where they stood, or from matches."""
        self.usable = self.usable & shape.valid.ravel()
        if not self.usable.any():
            return
        self.keep_patch(previous)
        self.points.status[~self.usable & self.fits_image.ravel()] = shape.status.ravel()[
            ~self.usable & self.fits_image.ravel()
        ]
        if shape.starts is not None:
            self.known_w = shape.starts.w.reshape(len(self.xy_px), -1)
        if previous is not None:
            self.hoped_for = self.usable & previous.valid.ravel()
        else:
            self.hoped_for = self.usable
        self._forget_attempts()
        if previous is not None and previous.starts is not None and previous.starts.G is not None:
            n = len(self.xy_px)
            w, G = previous.starts.w.reshape(n, -1), previous.starts.G.reshape(n, 3, -1)
            if self._sample_holds(w, G):
                if self.patch.patch == "curved":
                    self._refit_curved()
                # the sample stands already, fitted from these very starts
                sample = np.flatnonzero(self.points.ok)
                if self.points.G.shape == G.shape:
                    G = predict(self.pair, self.xy_px, G, sample, self.points.w[sample], self.points.G[sample])
                known = np.isfinite(w).all(axis=1) & np.isfinite(G).all(axis=(1, 2))
                index = np.flatnonzero(self.usable & known & ~self.points.ok)
                self.progress("previous", 0, len(index))
                fit_in_batches(
                    self.fitter,
                    self.points,
                    index,
                    self.xy_px,
                    w[index],
                    G[index],
                    far_px=SAMPLE_FAR_PX,
                    cancel=self.cancel,
                )
                self.check()
                return
        self.progress("seeds", 0, 1)
        if seeds is not None:
            self._user_motion(as_seeds(seeds))
        elif not (self.known_w is not None and self._stayed()):
            self.points.status[self.usable] = PointStatus.NOT_SEEDED
            if self._match_seeds() == 0:
                self._searched_motion()
        self.progress("seeds", 1, 1)

    def _stayed(self) -> bool:
        """Try whether the surface is about where it was: not on a texture that looks alike a period further on."""
        assert self.known_w is not None
        return self._sample_holds(self.known_w, no_motion(self.pair, self.xy_px), once_only=True)

    def _sample_holds(self, w: Float, G: Float, *, once_only: bool = False) -> bool:
        """Fit a spread sample from given starts; True (and the sample stands as seeds) if nearly all of it matches."""
        usable = self.usable & np.isfinite(w).all(axis=1) & np.isfinite(G).all(axis=(1, 2))
        if once_only:
            usable &= ~self.repeating
        if usable.sum() < 1:
            return False
        index = spread(self.xy_px, usable, np.zeros(len(usable)))[0]
        fits = refine(self.fitter, self.xy_px[index], Starts(w[index], G[index]), far_px=SAMPLE_FAR_PX)
        if fits.ok.mean() < _SAMPLE_SHARE:
            return False
        good = np.flatnonzero(fits.ok)
        self.points.put(index[good], fits.take(good))
        return True

    def _match_seeds(self) -> int:
        """Seeds from feature matches; how many stand. Large images are reduced, less and less until seeds are found."""
        if not (self.usable & ~self.repeating).any():
            return 0
        reach = self.options.subset_px + self.grid.step_px
        box1 = box_around(self.xy_px[self.usable], reach, self.ref1.shape)
        box2 = seen_by_camera2(self.pair, box1, self.ref2.shape)
        for scale in scales((box1, box2), (self.ref1.shape, self.ref2.shape)):
            found = self._match_seeds_at(scale, box1, box2)
            if found > 0:
                return found
        return 0

    def _match_seeds_at(self, scale: int, box1: Box, box2: Box) -> int:
        raise_if_cancelled(self.cancel)
        wanted = [(self.ref1, box1)]
        if self.known_w is None:
            wanted.append((self.ref2, box2))
        if self.cur1 is not None and self.cur2 is not None:
            wanted += [(image, (0, 0, *image.shape[::-1])) for image in (self.cur1, self.cur2)]
        features = features_of(wanted, scale)
        raise_if_cancelled(self.cancel)
        shape = ScatteredShape.empty() if self.known_w is not None else scattered_shape(self.pair, *features[:2])
        motion = shape_now = None
        if self.cur1 is not None:
            motion = scattered_motion(features[0], features[-2])
            raise_if_cancelled(self.cancel)
            shape_now = scattered_shape(self.pair, *features[-2:])
        elif len(shape.xy_px) < _FEWEST_MATCHES:
            return 0

        def put_seeds(motion: ScatteredMotion | None) -> int:
            return seeds_from_matches(
                self.fitter,
                self.points,
                self.xy_px,
                self.usable & ~self.repeating,
                shape,
                motion,
                shape_now,
                self.known_w,
            )

        found = put_seeds(motion)
        if found == 0 and motion is not None:
            # a strain or tilt too large for the features' own tolerance
            found = put_seeds(stretched_motion(self.ref1.pixels, box1, features[-2], scale))
        return found

    def _swept_shape(self) -> None:
        for i in swept_places(self.xy_px, self._rather_whole(self.usable & ~self.repeating)):
            raise_if_cancelled(self.cancel)
            found = sweep_shape(self.fitter, self.ref1.pixels, self.ref2.pixels, self.xy_px[i])
            if found.ok[0]:
                self.points.put(np.array([i]), found)

    def _searched_motion(self) -> None:
        if self.known_w is None:
            return
        known = self.usable & np.isfinite(self.known_w).all(axis=1) & ~self.repeating
        for i in swept_places(self.xy_px, self._rather_whole(known))[:6]:
            raise_if_cancelled(self.cancel)
            found = search_motion(self.fitter, self.xy_px[i], self.known_w[i])
            if found.ok[0]:
                self.points.put(np.array([i]), found)

    def _rather_whole(self, usable: Bool) -> Bool:
        """Of usable points those that see all of their subset, where there are any: searches compare whole squares."""
        whole = usable if self.sight is None else usable & self.sight.whole
        return whole if whole.any() else usable

    def _nearest(self, seeds: tuple[Seed, ...], usable: Bool) -> NDArray[np.intp]:
        reach = max(_REACH_STEPS * self.grid.step_px, float(self.options.subset_px))
        return nearest_points(seeds, self.xy_px, usable, reach_px=reach, sight=self.sight)

    def _user_shape(self, seeds: tuple[Seed, ...]) -> None:
        for seed, i in zip(seeds, self._nearest(seeds, self.usable), strict=True):
            raise_if_cancelled(self.cancel)
            found = PointFits.empty(1, 1)
            if seed.xy2_px is not None:
                p = self.pair.triangulate(np.array([seed.xy_px]), np.array([seed.xy2_px]))
                depth = self.pair.cam1.cam_from_sys.apply(p.xyz_mm)[:, 2]
                found = refine(
                    self.fitter.shape_only(), self.xy_px[i : i + 1], Starts(np.array([[1.0 / depth[0], 0.0, 0.0]]))
                )
            if not found.ok[0]:
                found = sweep_shape(self.fitter, self.ref1.pixels, self.ref2.pixels, self.xy_px[i])
            if found.ok[0]:
                self.points.put(np.array([i]), found)

    def _user_motion(self, seeds: tuple[Seed, ...]) -> None:
        if self.known_w is None:
            raise SeedError("a seed for a motion needs the shape that was measured before it.")
        usable = self.usable & np.isfinite(self.known_w).all(axis=1)
        index = self._nearest(seeds, usable)
        for i in index[~self.repeating[index]]:
            raise_if_cancelled(self.cancel)
            found = search_motion(self.fitter, self.xy_px[i], self.known_w[i])
            if found.ok[0]:
                self.points.put(np.array([i]), found)
        if not self.points.ok.any():
            # turned or stretched too far for a template: matches about the seed know how
            self._match_seeds()

    # field

    def finish(self, automatic: bool, shape: Field | None) -> Field:
        """Grow, check, grow into the gaps, check again, and hand over."""
        self.fill_field(automatic, shape)
        return assemble(
            self.points, pair=self.pair, grid=self.grid, fits_image=self.fits_image, shape=shape, patch=self.patch
        )

    def fill_field(self, automatic: bool, shape: Field | None) -> None:
        """Grow, check, grow into the gaps, and check again."""
        if not self.points.ok.any() and (shape is None or shape.valid.any()):
            remedy = (
                "Check that both cameras see the same textured surface and that the calibration belongs to these "
                "images, or give a seed point. A texture that repeats itself gives no start."
            )
            stated = self.fitter.ref1.noise_variance
            if stated is not None:
                remedy += (
                    f" The noise model says {stated**0.5:.1f} grey levels: with too much, texture passes for noise; "
                    "try without it."
                )
            raise SeedError("no point of the region could be matched between the images from any start.", remedy=remedy)
        if self.patch.patch == "curved" and self.fitter.terms == 3:
            self._refit_curved()
        self._fill()
        self._settle_patch()
        mark_outside(self.fitter, self.points, self.xy_px, self.usable)
        if automatic and self._unreached() > _LEFT_OVER and self._match_seeds() > 0:
            self._forget_attempts()
            self._grow()
            self.check()
        judged = judge(
            self.fitter,
            self.points,
            xy_px=self.xy_px,
            texture=self.texture,
            limits=self.sigma_limits,
            cancel=self.cancel,
        )
        if judged.refused:
            self.check()  # points that stand alone now have nothing to confirm them
        mark_outside(self.fitter, self.points, self.xy_px, self.usable)
        if self.blur is not None:
            refuse_near_edges(self.fitter, self.points, self.xy_px, self.blur)
        self.progress("done", int(self.points.ok.sum()), int(self.usable.sum()))
