"""Adam on the rows of the gaussians, with moments on the device (cl/adam.cl).

Every row and its moments move in each step, as Adam does: on our data sets this is 0.5 to 1 dB
ahead after 1000 steps of moving only what the view sees. It costs about the same, since
`DeviceAdam` is lazy: rows that no view saw keep parameters and moments until a view may see them or
the model is read, and then catch up. `NumpyAdam` (numpy_adam.py) is
the readable reference. Neither changes a row whose gradient is not finite, nor its moments, in that
step.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import CATCH_UP_EVERY, FRAME_COUNTS, LAZY_TERMS, SH_C0, SMALL_COLUMNS
from clsplat.device import Array, ArraySpec, Device
from clsplat.gaussians import LEARNED
from clsplat.optimise.adam_kernels import CATCH_UP, CLEAR, PAGED, SEEN, STEP, adam_defines
from clsplat.optimise.moments import AS_CODES, AS_REALS
from clsplat.optimise.pages import Pages
from clsplat.optimise.rates import corrections
from clsplat.primitives.gather import download_rows, gather
from clsplat.rendering.blend import Defines
from clsplat.rendering.project import FieldGradients, Gradients, paged_defines

LAG = ("last_step", "coefficients", "is_current")  # what checkpoints keep of lazy rows
HostArrays = dict[str, NDArray[np.floating]]  # field name -> [N, *row shape]
MOMENTS_OF_REST = "m_rest", "v_rest"  # of the harmonics above the constant, by their kernels' names
SMALL = tuple(field for field in LEARNED if field.name != "sh_rest")  # fields of the small columns
_COLUMNS = {
    field.name: slice(end - field.width(0), end)
    for field, end in zip(SMALL, accumulate(field.width(0) for field in SMALL))
}


class DeviceAdam:
    """Adam with its moments on the device.

    `rows` are the parameters, field name -> real[N, *row shape]; `steps` is the number of the last
    step; `is_current`: no row lags behind it. `pages`, if given, have `sh_rest` of the rows and its
    moments; the rows then have `places` and `slots` of these.
    """

    RECORDS = True  # whether a step can be recorded
    STORED = AS_REALS
    BUILD: Defines = ()
    NUMBERS = ("now", "before", "first", "correction", *(f"rate_{field.name}" for field in LEARNED))

    def __init__(self, device: Device, rows: Mapping[str, Array], pages: Pages | None = None) -> None:
        self.device, self.pages = device, pages
        self.harmonics = rows["sh_rest"].shape[1]
        self._m, self._v, self._others = (
            {name: device.zeros(*spec) for name, spec in specs.items() if not (pages and name == "rest")}
            for specs in self.arrays(rows)
        )
        self.steps, self.is_current = 0, True
        self._degree = math.isqrt(self.harmonics + 1) - 1

    @classmethod
    def arrays(cls, rows: Mapping[str, Array | ArraySpec]) -> tuple[dict[str, ArraySpec], ...]:
        """The arrays of m, of v and others, by name, for parameters of these shapes."""
        count, (_, harmonics, _) = rows["positions"].shape[0], rows["sh_rest"].shape
        m, v = (
            {"small": ArraySpec((count, SMALL_COLUMNS), dtype), "rest": ArraySpec((count, 3 * harmonics), dtype)}
            for dtype in cls.STORED.dtypes
        )
        return (
            m,
            v,
            {
                "last_step": ArraySpec((count,), np.uint32),
                "coefficients": ArraySpec((CATCH_UP_EVERY, LAZY_TERMS)),
                "no_gradient": ArraySpec((1, 1, 3)),
                "none_frozen": ArraySpec((1,), np.uint32),
                "no_counts": ArraySpec((FRAME_COUNTS,), np.uint32),
            },
        )

    @staticmethod
    def numbers(step: int, rates: Mapping[str, float]) -> dict[str, float]:
        """What `catch_up_seen` and `apply` need of a step, from 1; `rates` are learning rates by
        field."""
        first, correction = corrections(step)
        return {
            "now": step,
            "before": step - 1,
            "first": first,
            "correction": correction,
            **{f"rate_{field.name}": rates[field.name] * first for field in LEARNED},
        }

    def catch_up_seen(
        self,
        rows: Mapping[str, Array],
        numbers: Mapping[str, float],
        degree: int,
        frozen: Array | None,
        camera: Array,
        counts: Array,
    ) -> None:
        """Move rows that a view may see by the steps in which they had no gradient.

        `camera` is real[27], packed; `degree` that of the active harmonics; nothing moves once a
        frame has failed (`counts`); the rest is as for `apply`.
        """
        self._coast(rows, frozen, camera, True, numbers["before"], degree, counts)

    def apply(
        self,
        rows: Mapping[str, Array],
        gradients: Gradients,
        numbers: Mapping[str, float],
        degree: int,
        frozen: Array | None = None,
    ) -> None:
        """Update the rows that have a gradient in place, unless their frame has failed.

        Parameters
        ----------
        rows : field name -> real[N, *row shape], the parameters.
        gradients : of a view or a batch, without those of frozen gaussians.
        numbers : of `numbers`.
        degree : of the active harmonics, which never falls; the others do not change.
        frozen : gradients of frozen gaussians are left out already.
        """
        fields, by_harmonics = gradients.fields, self._others["no_gradient"]
        if isinstance(fields, FieldGradients):
            colours, directions, share = fields.grad_colours, fields.directions, SH_C0
        else:
            colours = directions = fields["sh_constant"]  # no directions are read
            share = 1.0
            if degree:
                by_harmonics = fields["sh_rest"]
        self.device.launch(
            STEP,
            self._defines(rows, degree),
            work=max(len(gradients.rows), CATCH_UP_EVERY),
            rank_one=int(isinstance(fields, FieldGradients)),
            share=share,
            counts=gradients.counts,
            **{name: numbers[name] for name in self.NUMBERS if name != "before"},
            visible=gradients.visible,
            rows=gradients.rows,
            grad_colours=colours,
            directions=directions,
            grad_sh_rest=by_harmonics,
            **{f"grad_{field.name}": fields[field.name] for field in SMALL if field.name != "sh_constant"},
            **self._state_of(rows),
        )

    def advance(
        self, step: int, degree: int, rows: Callable[[], Mapping[str, Array]], frozen: Array | None, counts: Array
    ) -> None:
        """Note that a step was enqueued; every CATCH_UP_EVERY-th moves all rows that lag.

        `rows` returns the rows as they were for `apply`; the rest is as for `catch_up_seen`.
        """
        self.steps, self._degree, self.is_current = step, degree, step % CATCH_UP_EVERY == 0
        if self.is_current:
            self._coast(rows(), frozen, None, True, step, degree, counts)

    def catch_up(self, rows: Mapping[str, Array], frozen: Array | None = None) -> None:
        """Move all rows that lag behind the last step.

        When this is done decides how results round, so it may depend on nothing but the steps; for
        anything else there is `current`.
        """
        if not self.is_current:
            self._coast(rows, frozen, None, True, self.steps, self._degree)
            self.is_current = True

    def seen(
        self,
        rows: Mapping[str, Array],
        camera: Array,
        now: float,
        margin: float,
        ahead: tuple[float, float] = (0.0, 0.0),
    ) -> Array:
        """Flag the rows that a view may see once they have caught up, uint[N].

        `camera` is real[27], packed; `now` is the number of the last step, `margin` are pixels
        beside the image; `ahead` the sums of rates, of positions and of scales, of later steps
        after which they may see it.
        """
        flags = self.device.empty(len(rows["positions"]), np.uint32)
        self.device.launch(
            SEEN,
            self._defines({}, 0),
            count=len(flags),
            now=now,
            margin=margin,
            position_ahead=ahead[0],
            scale_ahead=ahead[1],
            camera=camera,
            coefficients=self._others["coefficients"],
            positions=rows["positions"],
            log_scales=rows["log_scales"],
            last_step=self._others["last_step"],
            flags=flags,
        )
        return flags

    def current(self, rows: Mapping[str, Array], chosen: Array, frozen: Array | None = None) -> dict[str, Array]:
        """Copies of chosen rows, uint[C], as they are after the last step; if they are paged, their
        pages must be there."""

        def taken(array: Array, which: Array = chosen) -> Array:
            # not kept for others when it is freed, as each view has its own number of rows
            copy = self.device.allocate((len(which), *array.shape[1:]), array.dtype)
            return gather(self.device, array, which, copy)

        rest = self.pages.rest_of(chosen) if self.pages else chosen
        state = {
            name: taken(array, rest if name.endswith("_rest") else chosen)
            for name, array in self._state_of(rows).items()
            if array is not None and name not in ("coefficients", *PAGED)
        }
        if not self.is_current:
            self._launch_coast(
                {**state, "coefficients": self._others["coefficients"], **dict.fromkeys(PAGED)},
                self._defines({}, self._degree),
                None if frozen is None else taken(frozen),
                None,
                False,
                self.steps,
                None,
            )
        return {field.name: state[field.name] for field in LEARNED}

    def _coast(
        self,
        rows: Mapping[str, Array],
        frozen: Array | None,
        camera: Array | None,
        keeps: bool,
        now: float,
        degree: int,
        counts: Array | None = None,
    ) -> None:
        """Move the rows that lag, or of these the ones that a camera may see."""
        is_paged = self.pages is not None and degree > 0
        for _ in self.pages.rounds() if self.pages and is_paged and camera is None else (None,):
            if is_paged:
                self.pages.note_change()  # type: ignore[union-attr]
            self._launch_coast(self._state_of(rows), self._defines(rows, degree), frozen, camera, keeps, now, counts)

    def _launch_coast(
        self,
        state: Mapping[str, Array | None],
        defines: Defines,
        frozen: Array | None,
        camera: Array | None,
        keeps: bool,
        now: float,
        counts: Array | None,
    ) -> None:
        last_step = state["last_step"]
        assert last_step is not None
        self.device.launch(
            CATCH_UP,
            defines,
            count=len(last_step),
            now=now,
            keeps=int(keeps),
            has_frozen=int(frozen is not None),
            by_camera=int(camera is not None),
            counts=self._others["no_counts"] if counts is None else counts,
            camera=self._others["no_gradient"].reshaped(3) if camera is None else camera,
            frozen=self._others["none_frozen"] if frozen is None else frozen,
            **state,
        )

    def _defines(self, rows: Mapping[str, Array], degree: int) -> Defines:
        return adam_defines(self.harmonics, degree) + self.BUILD + paged_defines(rows, degree)

    def _state_of(self, rows: Mapping[str, Array]) -> dict[str, Array | None]:
        """Rows and moments by the names that they have in the kernels."""
        m, v = self._m, self._v
        rest = self.pages.arrays if self.pages else {"m_rest": m["rest"], "v_rest": v["rest"]}
        return {
            **{field.name: rows[field.name] for field in LEARNED},
            "m": m["small"],
            "v": v["small"],
            **rest,
            "last_step": self._others["last_step"],
            "coefficients": self._others["coefficients"],
            **{name: rows.get(name) for name in PAGED},
        }

    def regrow(self, source: Array, kept: int) -> None:
        """Rearrange the moments as growth rearranged the rows, which must have caught up.

        `source` is uint[M], the old row of each new row; the first `kept` keep their moments, and
        those of the others begin at 0.
        """
        for moments in (self._m, self._v):
            for name, old in moments.items():
                new = self.device.zeros((len(source), *old.shape[1:]), old.dtype)
                gather(self.device, old, source.narrow(kept), new)
                moments[name] = new
        self._start_lag(len(source))

    def _start_lag(self, count: int) -> None:
        """From now on there are `count` rows, and none lags."""
        self._others["last_step"] = self.device.allocate((count,), np.uint32)
        self._others["last_step"].fill(self.steps)
        self.is_current = True

    def use_pages(self, make: Callable[[dict[str, NDArray[Any]]], Pages]) -> None:
        """Let pages have the moments of the harmonics from now on; `make` makes them of these."""
        self.pages = make(
            {name: each.pop("rest").download() for name, each in zip(MOMENTS_OF_REST, (self._m, self._v))}
        )

    def reset(self, name: str) -> None:
        """Set the moments of one field, not sh_rest, to 0."""
        m, v, columns = self._m["small"], self._v["small"], _COLUMNS[name]
        self.device.launch(CLEAR, self._defines({}, 0), count=len(m), begin=columns.start, end=columns.stop, m=m, v=v)

    def download(self, rows: NDArray[np.integer] | None = None) -> tuple[HostArrays, HostArrays]:
        """m and v of rows, int[K], or of all if that is None, in host memory, by field, each row
        after its last step."""

        def stored(name: str) -> Iterator[NDArray[Any]]:
            for kind, own in zip(MOMENTS_OF_REST, (self._m, self._v)):
                if name == "rest" and self.pages:
                    yield self.pages.download(kind)[slice(None) if rows is None else rows]
                else:
                    yield download_rows(self.device, own[name], rows)

        small, rest = (self.STORED.moments(*stored(name)) for name in ("small", "rest"))
        count = len(small[0])
        return tuple(
            {  # type: ignore[return-value]  # two of them
                field.name: others.reshape(count, self.harmonics, 3)
                if field.name == "sh_rest"
                else np.ascontiguousarray(columns[:, _COLUMNS[field.name]]).reshape(count, *field.row_shape(0))
                for field in LEARNED
            }
            for columns, others in zip(small, rest)
        )

    def upload(self, m: HostArrays, v: HostArrays) -> None:
        """Take over moments from host arrays by field, for rows that have caught up.

        Where their number is another, the parameters must change to it, too.
        """
        for name, codes in self._stored(m, v):
            if name == "rest" and self.pages:
                for of_pages, values in zip(MOMENTS_OF_REST, codes):
                    self.pages.write(of_pages, values)
                continue
            for own, values in zip((self._m, self._v), codes):
                del own[name]  # so that new moments take the memory of the old ones
                own[name] = self.device.upload(values)
        self._start_lag(len(m["positions"]))

    def write(self, m: HostArrays, v: HostArrays, first: int) -> None:
        """Overwrite the moments of as many rows from `first` on, which have caught up."""
        for name, codes in self._stored(m, v):
            for kind, own, values in zip(MOMENTS_OF_REST, (self._m, self._v), codes):
                if name == "rest" and self.pages:
                    self.pages.write(kind, values, first)
                else:
                    own[name].write(values, first)

    def _stored(self, m: HostArrays, v: HostArrays) -> Iterator[tuple[str, Sequence[NDArray[Any]]]]:
        """Moments by field as they are stored: the names of both arrays, and their values."""
        count = len(m["positions"])
        yield (
            "small",
            self.STORED.codes(
                *(np.column_stack([source[field.name].reshape(count, -1) for field in SMALL]) for source in (m, v))
            ),
        )
        yield "rest", self.STORED.codes(*(source["sh_rest"].reshape(count, 3 * self.harmonics) for source in (m, v)))

    def lag(self) -> dict[str, NDArray[Any]]:
        """How far each row has come, in host memory, for a checkpoint."""
        return {
            "last_step": self._others["last_step"].download(),
            "coefficients": self._others["coefficients"].download(),
            "is_current": np.array([self.is_current], np.uint8),
        }

    def load_lag(self, arrays: Mapping[str, NDArray[Any]], step: int) -> None:
        """Restore what `lag` returned, after `upload` and after this number of steps."""
        for name in ("last_step", "coefficients"):
            self._others[name].write(arrays[name])
        self.steps, self.is_current = step, bool(arrays["is_current"][0])


class CodedAdam(DeviceAdam):
    """Adam with its moments on the device, each in three bytes in place of eight
    (cl/include/moments.h)."""

    STORED = AS_CODES
    BUILD: Defines = (("CODED", 1),)
