"""Finds what moved or glared: pixels of a photo that the model explains well in other photos.

The largest residuals of real photos lie where the model is not learned yet, at borders that one or
two photos see. So the residual of a photo is compared with what the same gaussians leave in all
other photos. A place that is explained there but not here has changed; one that is explained
nowhere is not learned yet, and must not be left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.constants import SH_C0
from clsplat.device import Array
from clsplat.loss.options import RobustOptions
from clsplat.rendering.blend import Exposure
from clsplat.rendering.contribution import contribution
from clsplat.rendering.pipeline import Frame, Renderer
from clsplat.rendering.project import Rows
from clsplat.training.part import Decision, Part, State, Survey, requested

if TYPE_CHECKING:
    from clsplat.schedule.plan import Plan
    from clsplat.training.photos import Photos
    from clsplat.training.session import Session
    from clsplat.training.start.prepare import PreparedScene

CELL = 4  # pixels: the width of a cell, over which signed differences are averaged
FACTOR = 6.0  # of the residual in other photos, above which a cell is an outlier
FLOOR = 8.0  # times the median residual of all cells: no outlier below
NEIGHBOURS = 5 / 9  # share of the 3x3 cells around one that are outliers if it is ignored
MIN_WEIGHT = 0.05  # pixels that a gaussian covers in a photo that sees it
MIN_OTHER_VIEWS = 3  # photos that see a gaussian besides this one
MIN_COVERAGE = 0.7  # share of a cell that gaussians cover which so many others see
SEARCHES = 8  # in a run, or fewer, so that between two of them there are at least
MIN_EPOCHS = 5
MAX_MASKED_SHARE = 0.25  # share of a photo that may be ignored
TINY = 1e-6  # above rounding

Cells = NDArray[np.bool_]
Floats = NDArray[np.float64]


class ObservedView(NamedTuple):
    """A training view at the present level."""

    camera: Array  # real[27], packed
    photo: NDArray[np.uint8]  # [3, H, W]
    valid: NDArray[np.bool_]  # [H, W], pixels that count by the photo's own mask
    exposure: Exposure | None = None  # as for `Renderer.render`


def spread(cells: NDArray[Any], height: int, width: int) -> NDArray[Any]:
    """The pixels [height, width] of values of cells."""
    return cells.repeat(CELL, axis=0).repeat(CELL, axis=1)[:height, :width]


def resampled(cells: Cells, height: int, width: int) -> Cells:
    """The cells of a photo that is height x width pixels at another level, each as the cell was
    that has its centre."""
    rows, columns = (
        np.minimum(((np.arange(new) + 0.5) * old / new).astype(np.int64), old - 1)
        for new, old in zip((_cells_along(height), _cells_along(width)), cells.shape)
    )
    return cells[np.ix_(rows, columns)]


def find_outliers(
    renderer: Renderer,
    rows: Rows,
    sh_degree: int,
    views: Callable[[], Iterable[ObservedView]],
    shown: Callable[[Array], Rows] | None = None,
) -> list[Cells]:
    """The cells of each view that are ignored; waits. `views` returns all training views in their
    order, and is called twice; `shown` is as for `taming_scores`."""
    explained = _Explained(renderer, rows, sh_degree, shown or (lambda camera: rows))
    found = [explained.add(view) for view in views()]
    scale = float(np.median(np.concatenate([each.ravel() for each in found])))
    return [_outliers(residual, *explained.expected(view, residual), scale) for view, residual in zip(views(), found)]


class _Explained:
    """What the gaussians leave unexplained in all photos together: sums over views of a gaussian's
    blending weights, of these times the residual of their pixels, and how many views see it."""

    def __init__(self, renderer: Renderer, rows: Rows, sh_degree: int, shown: Callable[[Array], Rows]) -> None:
        self.renderer, self.rows, self.sh_degree, self.shown = renderer, rows, sh_degree, shown
        self.weights, self.errors, self.photos = np.zeros((3, len(rows["positions"])))

    def add(self, view: ObservedView) -> Floats:
        """Add a view; returns the residuals of its cells."""
        frame = self._frame(view)
        found = _residuals(frame.exposed.download(), view)
        visible, weights, errors = self._sums(frame, view, found)
        self.weights[visible] += weights
        self.errors[visible] += errors
        self.photos[visible] += weights >= MIN_WEIGHT
        return found

    def expected(self, view: ObservedView, residual: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """From all views but this one, which was added with this residual: what is expected to be
        left in each cell, and whether they see enough of it."""
        _, height, width = view.photo.shape
        visible, weights, errors = self._sums(self._frame(view), view, residual)
        other = np.maximum(self.weights[visible] - weights, 0)
        values = np.zeros((len(self.weights), 3), np.float64)
        values[visible, 0] = np.maximum(self.errors[visible] - errors, 0) / np.maximum(other, 1e-9)
        values[visible, 1] = self.photos[visible] - (weights >= MIN_WEIGHT) >= MIN_OTHER_VIEWS
        # both are rendered as colours
        rows = {
            **self.rows,
            "sh_constant": self.renderer.device.upload(
                ((np.minimum(values, 1) - 0.5) / SH_C0).astype(self.renderer.device.real)
            ),
        }
        shown = self.renderer.render(rows, view.camera, width, height, 0)
        through = shown.blended.transmittance.download()
        background = self.renderer.background.download()
        image = shown.image.download()[:2] - background[:2, None, None] * through
        expected, served, opaque = _cell_means(np.stack([*image, 1 - through]), view.valid)
        return expected / np.maximum(opaque, 1e-3), served >= MIN_COVERAGE

    def _frame(self, view: ObservedView) -> Frame:
        _, height, width = view.photo.shape
        return self.renderer.render(
            self.shown(view.camera), view.camera, width, height, self.sh_degree, exposure=view.exposure
        )

    def _sums(self, frame: Frame, view: ObservedView, residual: Floats) -> tuple[NDArray[np.uint32], Floats, Floats]:
        """The visible rows of a frame; their weights in it, and these times the residuals."""
        device, pixels = self.renderer.device, spread(residual, *view.photo.shape[1:])
        totals = contribution(device, frame, device.upload(pixels)).download()
        _, weights, errors, _ = totals.T.astype(np.float64)
        return frame.visible.download(), weights, errors


def _residuals(image: NDArray[np.floating], view: ObservedView) -> Floats:
    """Residuals of cells [H/CELL, W/CELL]: the mean over colours of |mean difference| of an image
    [3, H, W] and the view's photo.

    Differences of fine texture that is not learned yet cancel within a cell; those of something
    else at its place do not.
    """
    found: Floats = np.abs(_cell_means(image - view.photo / 255, view.valid)).mean(axis=0)
    return np.nan_to_num(found, nan=0.0, posinf=0.0)


def _outliers(residual: Floats, expected: Floats, served: NDArray[np.bool_], scale: float) -> Cells:
    """The cells of a photo that are ignored, by the residual of each cell and the expected one,
    whether other photos see enough of it, and the median residual of all cells of all photos."""
    least = np.maximum(np.maximum(FACTOR * expected, FLOOR * scale), 1e-9)
    ratio = np.where(served, residual / least, 0)
    found = ratio > max(1.0, float(np.quantile(ratio, 1 - MAX_MASKED_SHARE)))
    around = scipy.ndimage.uniform_filter(found.astype(np.float64), 3, mode="nearest")
    coherent: Cells = around > NEIGHBOURS - TINY
    grown: Cells = scipy.ndimage.uniform_filter(coherent.astype(np.float64), 3, mode="constant") > TINY
    return grown & served if grown.mean() <= MAX_MASKED_SHARE else coherent


def _cells_along(length: int) -> int:
    return -(-length // CELL)


def _cell_means(values: NDArray[np.floating], valid: NDArray[np.bool_]) -> Floats:
    """Means [..., H/CELL, W/CELL] over the valid pixels of cells; 0 where a cell has none."""
    sums, counts = np.where(valid, values, 0), valid.astype(np.float64)
    for axis in (-2, -1):
        places = np.arange(0, values.shape[axis], CELL)
        sums, counts = (np.add.reduceat(each, places, axis=axis, dtype=np.float64) for each in (sums, counts))
    return sums / np.maximum(counts, 1)


class OutlierMasks(Part):
    """Leaves out of the photos what moved or glared, which it looks for several times in a run."""

    name = "robust"
    Options = RobustOptions
    _calm_since = 0  # step of the latest search, change of level or reset of opacities

    @classmethod
    def decide(cls, survey: Survey) -> dict[str, Decision]:
        return {"robust": requested(survey.options.robust)}

    @classmethod
    def is_used(cls, prepared: PreparedScene) -> bool:
        return prepared.options.robust == "on"

    def begin(self, session: Session) -> None:
        self._photos: Photos = session.photos

    def begin_level(self, session: Session) -> None:
        self._calm_since = session.iteration

    def opacities_reset(self, session: Session) -> None:
        self._calm_since = session.iteration

    def before_step(self, session: Session, plan: Plan) -> dict[str, float] | None:
        """Find the pixels of all training photos that are left out from now on, if that is due.

        It is due some steps after something has changed: until photos are explained again as well
        as before, little can be told. The record has their share of all pixels, and the largest
        share in a photo.
        """
        options = session.decisions.options
        epoch = -(-len(session.train_views) // options.batch)
        calm = session.iteration - self._calm_since
        every = max(options.iterations // SEARCHES, MIN_EPOCHS * epoch)
        if calm < every and not (plan.level != session.level and 3 * calm >= every):
            return None
        session.model.catch_up()
        session.step.release()  # these frames have other sizes
        cells = find_outliers(
            session.renderer, session.model.rows, plan.degree, lambda: _observed(session), session.model.seen
        )
        session.step.release()
        session.photos.ignore(cells)
        self._calm_since = session.iteration
        share = sum(int(each.sum()) for each in cells) / sum(each.size for each in cells)
        return {"share": round(share, 6), "most": round(max(float(each.mean()) for each in cells), 6)}

    def state(self) -> State:
        ignored = self._photos.ignored
        return {
            "disturbed_at": np.array(self._calm_since),
            **({} if ignored is None else {"cells": np.packbits(np.concatenate([each.ravel() for each in ignored]))}),
        }

    def load(self, state: State, session: Session) -> None:
        self._calm_since = int(state["disturbed_at"])
        if "cells" not in state:
            return
        shapes = [(_cells_along(view.camera.height), _cells_along(view.camera.width)) for view in session.photos.views]
        ends = np.cumsum([rows * columns for rows, columns in shapes])
        flat = np.unpackbits(state["cells"], count=int(ends[-1])).astype(bool)
        session.photos.ignore([each.reshape(shape) for each, shape in zip(np.split(flat, ends[:-1]), shapes)])


def _observed(session: Session) -> Iterator[ObservedView]:
    """All training views at this level, with their photos."""
    for index, work in enumerate(session.shown(range(len(session.train_views)))):
        photo = session.photos.unweighed(index)
        yield ObservedView(work.camera, photo[:3], photo[3] > 0, work.exposure)
