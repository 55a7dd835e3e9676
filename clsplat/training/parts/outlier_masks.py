"""Finds what moved or glared: pixels of a photo that the model explains well in other photos.

The largest residuals of real photos lie where the model is not learned yet, at borders that one or
two photos see. So the residual of a photo is compared with what the same gaussians leave in all
other photos. A place that is explained there but not here has changed; one that is explained
nowhere is not learned yet, and must not be left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from clsplat.constants import SH_C0
from clsplat.device import Array
from clsplat.loss.options import RobustOptions
from clsplat.rendering.blend import Exposure
from clsplat.rendering.contribution import contribution
from clsplat.rendering.pipeline import Frame, Renderer
from clsplat.rendering.project import Rows
from clsplat.training.part import Decision, Part, State, Survey

if TYPE_CHECKING:
    from clsplat.schedule import Plan
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

Cells = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class ObservedView:
    """A training view at the present level.

    Attributes
    ----------
    camera : real[27], packed.
    photo : uint8[3, H, W].
    valid : bool[H, W], pixels that count by the photo's own mask.
    exposure : as for `Renderer.render`.
    """

    camera: Array
    photo: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    exposure: Exposure | None = None


def cells_of(length: int) -> int:
    """The number of cells along a side of so many pixels."""
    return -(-length // CELL)


def cell_means(values: NDArray[np.floating], valid: NDArray[np.bool_] | None = None
               ) -> NDArray[np.float64]:
    """Means [..., H/CELL, W/CELL] over the valid pixels of cells; 0 where a cell has none.

    Parameters
    ----------
    values : [..., H, W].
    valid : [H, W]; None: all.
    """
    *_, height, width = values.shape
    weights = np.ones((height, width)) if valid is None else valid.astype(np.float64)
    sums, counts = (_summed(np.where(weights > 0, v, 0)) for v in (values, weights))
    return sums / np.maximum(counts, 1)


def _summed(values: NDArray[Any]) -> NDArray[np.float64]:
    for axis in (-2, -1):
        values = np.add.reduceat(values, np.arange(0, values.shape[axis], CELL), axis=axis,
                                 dtype=np.float64)
    return values


def spread(cells: NDArray[Any], height: int, width: int) -> NDArray[Any]:
    """The pixels [height, width] of values of cells."""
    return cells.repeat(CELL, axis=0).repeat(CELL, axis=1)[:height, :width]


def residuals(image: NDArray[np.floating], view: ObservedView) -> NDArray[np.float64]:
    """Residuals [H/CELL, W/CELL] of cells: the mean over colours of |mean difference|.

    Differences of fine texture that is not learned yet cancel within a cell; those of something
    else at its place do not.

    Parameters
    ----------
    image : float[3, H, W], after the view's exposure.
    view : the view.
    """
    found: NDArray[np.float64] = np.abs(
        cell_means(image - view.photo / 255, view.valid)).mean(axis=0)
    return np.nan_to_num(found, nan=0.0, posinf=0.0)


class ResidualModel:
    """What the gaussians leave unexplained in all photos together.

    Attributes
    ----------
    weights, errors : float64[N], sums over views of a gaussian's blending weights, and of these
        times the residual of their pixels.
    photos : int64[N], how many views see a gaussian.
    """

    def __init__(self, renderer: Renderer, rows: Rows, sh_degree: int) -> None:
        self.renderer, self.rows, self.sh_degree = renderer, rows, sh_degree
        count = len(rows["positions"])
        self.weights, self.errors = np.zeros(count), np.zeros(count)
        self.photos = np.zeros(count, np.int64)

    def add(self, view: ObservedView) -> NDArray[np.float64]:
        """Add a view; returns the residuals of its cells."""
        frame = self._frame(view)
        found = residuals(frame.exposed.download(), view)
        visible, weights, errors = self._sums(frame, view, found)
        self.weights[visible] += weights
        self.errors[visible] += errors
        self.photos[visible] += weights >= MIN_WEIGHT
        return found

    def expected(self, view: ObservedView, residual: NDArray[np.float64]
                 ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """What all views but one leave unexplained where this one looks.

        Parameters
        ----------
        view : one that was added.
        residual : what `add` returned for it.

        Returns
        -------
        The residual that is expected in each cell, and whether other views see enough of it.
        """
        _, height, width = view.photo.shape
        visible, weights, errors = self._sums(self._frame(view), view, residual)
        other = np.maximum(self.weights[visible] - weights, 0)
        values = np.zeros((len(self.weights), 3), np.float64)
        values[visible, 0] = np.maximum(self.errors[visible] - errors, 0) / np.maximum(other, 1e-9)
        values[visible, 1] = self.photos[visible] - (weights >= MIN_WEIGHT) >= MIN_OTHER_VIEWS
        rows = {**self.rows, "sh_constant": self.renderer.device.upload(
            ((np.minimum(values, 1) - 0.5) / SH_C0).astype(self.renderer.device.real))}
        shown = self.renderer.render(rows, view.camera, width, height, 0)
        through = shown.blended.transmittance.download()
        background = self.renderer.background.download()
        image = shown.image.download()[:2] - background[:2, None, None] * through
        expected, served, opaque = cell_means(np.stack([*image, 1 - through]), view.valid)
        return expected / np.maximum(opaque, 1e-3), served >= MIN_COVERAGE

    def _frame(self, view: ObservedView) -> Frame:
        _, height, width = view.photo.shape
        return self.renderer.render(
            self.rows, view.camera, width, height, self.sh_degree, exposure=view.exposure)

    def _sums(self, frame: Frame, view: ObservedView, residual: NDArray[np.float64]
              ) -> tuple[NDArray[np.uint32], NDArray[np.float64], NDArray[np.float64]]:
        """The visible rows of a frame; their weights in it, and these times the residuals."""
        device, pixels = self.renderer.device, spread(residual, *view.photo.shape[1:])
        totals = contribution(device, frame, device.upload(pixels)).download()
        _, weights, errors, _ = totals.T.astype(np.float64)
        return frame.visible.download(), weights, errors


def outliers(residual: NDArray[np.float64], expected: NDArray[np.float64],
             served: NDArray[np.bool_], scale: float) -> Cells:
    """The cells of a photo that are ignored.

    Parameters
    ----------
    residual, expected : [h, w], of cells, in this photo and in the others.
    served : [h, w], whether other photos see enough of a cell.
    scale : the median residual of all cells of all photos.
    """
    ratio = np.where(served, residual / np.maximum(np.maximum(FACTOR * expected, FLOOR * scale),
                                                   1e-9), 0)
    limit = max(1.0, float(np.quantile(ratio, 1 - MAX_MASKED_SHARE)))
    found = ratio > limit
    around = uniform_filter(found.astype(np.float64), 3, mode="nearest")
    coherent: Cells = around > NEIGHBOURS - 1e-6
    grown: Cells = uniform_filter(coherent.astype(np.float64), 3, mode="constant") > 1e-6
    return grown & served if grown.mean() <= MAX_MASKED_SHARE else coherent


def is_due(calm: int, iterations: int, epoch: int, level_ends: bool) -> bool:
    """Whether outliers are looked for before a step.

    Parameters
    ----------
    calm : steps since they were last looked for, a level began or opacities were reset; until
        photos are explained again as well as before, little can be told.
    iterations : of the run.
    epoch : steps in which each view is trained on once.
    level_ends : whether the step is of another level.
    """
    every = max(iterations // SEARCHES, MIN_EPOCHS * epoch)
    return calm >= every or level_ends and 3 * calm >= every


def share_of(cells: Sequence[Cells]) -> float:
    """The share of the cells of all views that are ignored."""
    return sum(int(each.sum()) for each in cells) / sum(each.size for each in cells)


def find_outliers(renderer: Renderer, rows: Rows, sh_degree: int,
                  views: Callable[[], Iterable[ObservedView]]) -> list[Cells]:
    """The cells of each view that are ignored; waits.

    Parameters
    ----------
    renderer : renders the views.
    rows : field name -> real[N, *row shape].
    sh_degree : degree of the spherical harmonics that are used.
    views : returns all training views in their order; called twice.
    """
    explained = ResidualModel(renderer, rows, sh_degree)
    found = [explained.add(view) for view in views()]
    scale = float(np.median(np.concatenate([each.ravel() for each in found])))
    return [outliers(residual, *explained.expected(view, residual), scale)
            for view, residual in zip(views(), found)]


def resampled(cells: Cells, height: int, width: int) -> Cells:
    """The cells of a photo at another size, each as the cell was that has its centre.

    Parameters
    ----------
    cells : of the photo at its earlier size.
    height, width : of the photo, pixels.
    """
    rows, columns = (
        np.minimum(((np.arange(new) + 0.5) * old / new).astype(np.int64), old - 1)
        for new, old in zip((cells_of(height), cells_of(width)), cells.shape))
    return cells[np.ix_(rows, columns)]


def packed(cells: Sequence[Cells]) -> NDArray[np.uint8]:
    """Cells of all views in bits, for a checkpoint."""
    return np.packbits(np.concatenate([each.ravel() for each in cells]))


def unpacked(bits: NDArray[np.uint8], sizes: Sequence[tuple[int, int]]) -> list[Cells]:
    """What `packed` packed.

    Parameters
    ----------
    bits : of `packed`.
    sizes : (height, width) of the photos, pixels.
    """
    shapes = [(cells_of(height), cells_of(width)) for height, width in sizes]
    ends = np.cumsum([rows * columns for rows, columns in shapes])
    flat = np.unpackbits(bits, count=int(ends[-1])).astype(bool)
    return [part.reshape(shape) for part, shape in zip(np.split(flat, ends[:-1]), shapes)]


class OutlierMasks(Part):
    """Leaves out of the photos what moved or glared, which it looks for several times in a run.

    Attributes
    ----------
    disturbed_at : step of the latest search, change of level or reset of opacities.
    """

    name = "robust"
    Options = RobustOptions

    def __init__(self) -> None:
        self.disturbed_at = 0

    @classmethod
    def decide(cls, survey: Survey) -> dict[str, Decision]:
        """On only if requested."""
        if survey.options.robust == "on":
            return {"robust": Decision(
                "on", "on: requested; the record `robust` of the run has the share of the pixels "
                "that are left out", requested=True)}
        return {"robust": Decision("off", "off: not requested")}

    @classmethod
    def is_used(cls, prepared: PreparedScene) -> bool:
        """Whether it is requested."""
        return prepared.options.robust == "on"

    def begin(self, session: Session) -> None:
        """As `Part.begin`."""
        self._photos: Photos = session.photos

    def begin_level(self, session: Session) -> None:
        """As `Part.begin_level`."""
        self.disturbed_at = session.iteration

    def opacities_reset(self, session: Session) -> None:
        """As `Part.opacities_reset`."""
        self.disturbed_at = session.iteration

    def before_step(self, session: Session, plan: Plan) -> dict[str, float] | None:
        """Find the pixels of all training photos that are left out from now on, if that is due.

        The record has their share of all pixels, and the largest share in a photo.
        """
        options, views = session.decisions.options, len(session.train_views)
        if not is_due(session.iteration - self.disturbed_at, options.iterations,
                      -(-views // options.batch), plan.level != session.level):
            return None
        session.model.catch_up()
        session.step.release()  # these frames have other sizes
        cells = find_outliers(session.renderer, session.model.rows, plan.degree,
                              lambda: _observed(session))
        session.device.trim()
        session.photos.ignore(cells)
        self.disturbed_at = session.iteration
        return {"share": round(share_of(cells), 6),
                "most": round(max(float(each.mean()) for each in cells), 6)}

    def state(self) -> State:
        """As `Part.state`."""
        ignored = self._photos.ignored
        return {"disturbed_at": np.array(self.disturbed_at),
                **({} if ignored is None else {"cells": packed(ignored)})}

    def load(self, state: State, session: Session) -> None:
        """As `Part.load`."""
        self.disturbed_at = int(state["disturbed_at"])
        if "cells" in state:
            session.photos.ignore(unpacked(state["cells"], [
                (view.camera.height, view.camera.width) for view in session.photos.views]))


def _observed(session: Session) -> Iterator[ObservedView]:
    """All training views at this level, with their photos."""
    for index, work in enumerate(session.shown(range(len(session.train_views)))):
        photo = session.photos.unweighed(index)
        yield ObservedView(work.camera, photo[:3], photo[3] > 0, work.exposure)
