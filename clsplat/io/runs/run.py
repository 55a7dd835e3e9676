"""The folder of a run: the only code with its file names."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.errors import InputError, reason
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import PARTIAL, replacing
from clsplat.io.fields import numbers, reading
from clsplat.io.folders import make_folder
from clsplat.io.lock import HOLDER, LOCK, exclusive
from clsplat.io.models.ply import read_ply, write_ply
from clsplat.io.npz import read_npz, state_array, state_of, write_npz
from clsplat.io.photos.undistort import FOLDER as UNDISTORTED
from clsplat.io.records import check_format, object_of, plain, read_object, with_format, write_object
from clsplat.io.regular import read_regular
from clsplat.io.runs.origin import origin, recorded_scene, scene_record
from clsplat.placement.corrections import Correction
from clsplat.response import Response

EXPOSURES, POSES = "exposures.json", "poses.json"
TRANSFORM, VIGNETTING, POSE = 12, 4, 6  # numbers of a view
OPTIONS, METRICS = "options.json", "metrics.jsonl"
CHECKPOINT = "checkpoint.npz"
PICTURES = "renders/test"  # of held-out views, by `clsplat eval`
MODEL, REPORT = "point_cloud.ply", "report.html"
EARLIER = {"average": 0.0}  # options that earlier versions lacked, with what these did
PART_OF_CITY = "part_of_city"  # key of options.json: whether it is a coarse run or a block
# in the order of their removal
FILES = (METRICS, CHECKPOINT, EXPOSURES, POSES, MODEL, REPORT, OPTIONS)
CITY = "city.json"  # of a folder that `clsplat city` wrote: io/runs/city.py reads it
STATE = "state.json"  # the member of a checkpoint that holds everything but arrays


class RunFolder:
    """One training on disk: its options, metrics, checkpoint, model, report and renders.

    Every write replaces a whole file, except for lines of metrics; one that a kill cut short is
    dropped by the next `log` or `rewind`. Errors are InputError.
    """

    def __init__(self, path: str | Path) -> None:
        """Use `create` or `open`."""
        self.path = Path(path)
        self.pictures, self.model_path = self.path / PICTURES, self.path / MODEL
        self.undistorted = self.path / UNDISTORTED  # stays when the run is replaced
        self._metrics_whole = self._replaces = False

    @classmethod
    def create(cls, path: str | Path, overwrite: bool = False) -> RunFolder:
        """Begin a new run in a folder, see `begin_new`."""
        run = cls(path)
        run.begin_new(overwrite)
        return run

    def begin_new(self, overwrite: bool = False) -> None:
        """Begin a new run in the folder, which is created if needed. If it may hold a run, the
        first write, `write_options`, removes the files of that and nothing else."""
        make_folder(self.path, "choose another --output")
        self.check_free(overwrite)
        self._replaces = True

    def check_free(self, overwrite: bool) -> None:
        """InputError if a new run, which may replace one if `overwrite`, cannot begin here."""
        if (self.path / CITY).exists():
            raise InputError(
                f"{self.path}: holds a city ({CITY}); continue it with `clsplat city`, or choose another folder"
            )
        present = [name for name in FILES if os.path.lexists(self.path / name)]
        if present and not overwrite:
            raise InputError(
                f"{self.path}: already holds a run ({present[-1]}); continue it with "
                "--resume, replace it with --overwrite, or choose another folder"
            )
        if present and not self._is_ours():
            raise InputError(
                f"{self.path}: holds {present[-1]}, but no run that clsplat wrote; "
                "--overwrite removes runs only: choose another folder"
            )

    def _is_ours(self) -> bool:
        """Whether clsplat wrote the files of the folder, by its options or, if these are damaged,
        by its metrics."""
        marks = (OPTIONS, b'"version":'), (METRICS, b'{"event":')
        return any(mark in (self.path / name).read_bytes() for name, mark in marks if (self.path / name).is_file())

    @contextmanager
    def locked(self, patience: float = 0.0) -> Iterator[None]:
        """Lock the folder, as `lock.exclusive` does. It is created if needed, and removed again if
        nothing was written."""
        is_new = not self.path.exists()
        make_folder(self.path, "choose another --output")
        with exclusive(self.path, patience):
            try:
                yield
            finally:
                if is_new and set(os.listdir(self.path)) <= {LOCK, HOLDER}:
                    for name in (LOCK, HOLDER):
                        (self.path / name).unlink(missing_ok=True)
                    self.path.rmdir()

    @classmethod
    def open(cls, path: str | Path) -> RunFolder:
        """Open the run of a folder."""
        run = cls(path)
        if not run.is_begun:
            raise InputError(
                f"{run.path}: holds no run ({OPTIONS} is missing); give a folder that `clsplat train` wrote"
            )
        return run

    def _remove_files(self) -> None:
        """Remove the files of a run; links are removed, never followed."""
        if self.pictures.resolve() == self.path.resolve() / PICTURES:
            shutil.rmtree(self.pictures, ignore_errors=True)
        for name in FILES:
            (self.path / (name + PARTIAL)).unlink(missing_ok=True)
            (self.path / name).unlink(missing_ok=True)

    def write_options(self, record: dict[str, Any]) -> None:
        """Write the options of the run, with the keys of `origin`; the path `scene` is written
        relative to the run and absolute."""
        if self._replaces:
            self._remove_files()
            self._replaces = False
        record = with_format({**record, **origin()})
        if "scene" in record:
            record |= scene_record(record["scene"], self.path)
        write_object(self.path / OPTIONS, plain(record), indent=2)

    def scene_path(self, given: Path | None = None) -> Path:
        """Find the scene of the run, see `recorded_scene`."""
        return recorded_scene(self.read_options(), self.path, given)

    def note_scene(self, scene: Path) -> None:
        """Record where the scene is now, if that has changed."""
        record = self.read_options()
        place = scene_record(scene, self.path)
        if any(record.get(key) != value for key, value in place.items()):
            write_object(self.path / OPTIONS, record | place, indent=2)

    def read_options(self) -> dict[str, Any]:
        """Read what `write_options` wrote."""
        return {**EARLIER, **read_object(self.path / OPTIONS, {}, "start the run again with --overwrite")}

    @property
    def is_begun(self) -> bool:
        """Whether the run has options, which are written first."""
        return (self.path / OPTIONS).is_file()

    def log(self, record: dict[str, Any]) -> None:
        """Append one line to the metrics, of which the first has the number of the format; numbers
        that are not finite become null."""
        path = self.path / METRICS
        try:
            with open(path, "ab") as file:
                if not self._metrics_whole:
                    file.truncate(len(_whole_lines(path.read_bytes())))
                    self._metrics_whole = True
                is_first = os.fstat(file.fileno()).st_size == 0
                file.write(_line(with_format(record) if is_first else record))
        except OSError as error:
            self._metrics_whole = False
            raise InputError(
                f"{path}: cannot be written ({error.strerror}); free some space and continue with --resume"
            ) from error

    def picture(self, name: str) -> Path:
        """Where to write the picture of a held-out view; its folder is created.

        The suffix of the view's name is kept, or a.jpg and a.png would share one file.
        """
        path = self.pictures / f"{name}.png"
        if not path.resolve().is_relative_to(self.pictures.resolve()):
            raise InputError(f"{name}: a view's name must not leave the folder of pictures; rename it")
        make_folder(path.parent)
        return path

    def records(self) -> list[dict[str, Any]]:
        """The records of the metrics in order, [] if there are none yet; a last line that was cut
        short is left out."""
        path, records = self.path / METRICS, []
        lines = _whole_lines(path.read_bytes()).splitlines() if path.exists() else []
        for number, line in enumerate(lines, 1):
            try:
                records.append(object_of(line))
                check_format(path, records[-1])
            except ValueError as error:
                raise InputError(f"{path}: line {number} is damaged ({reason(error)}); remove that line") from None
        return records

    def add_scores(self, scores: dict[str, Any]) -> None:
        """Add scores of the finished model to the last evaluation in the metrics, if there is one;
        they replace those that are there."""
        records = self.records()
        evaluations = [record for record in records if record.get("event") == "eval"]
        if evaluations:
            evaluations[-1].update(scores)
            self._rewrite(records)

    def rewind(self, iteration: int) -> None:
        """Drop the metrics after an iteration, whose steps a resumed run repeats."""
        records = self.records()
        kept = [record for record in records if (record.get("iteration") or 0) <= iteration]
        if len(kept) < len(records):
            self._rewrite(kept)

    def _rewrite(self, records: Iterable[dict[str, Any]]) -> None:
        with replacing(self.path / METRICS) as file:
            file.writelines(map(_line, records))

    @property
    def has_checkpoint(self) -> bool:
        """Whether the run has a checkpoint."""
        return (self.path / CHECKPOINT).is_file()

    def saved_rows(self, iteration: int, positions: Callable[[], NDArray[np.floating]]) -> NDArray[np.integer] | None:
        """Which rows, int[K], a checkpoint after so many steps has; None: all. `positions` returns
        those of all rows, [N, 3]."""
        return None

    def save_checkpoint(self, arrays: dict[str, np.ndarray], state: dict[str, Any]) -> None:
        """Replace the checkpoint by arrays and a state for JSON; if this fails, such as on a full
        disk, the previous checkpoint stays."""
        with replacing(self.path / CHECKPOINT) as file:
            write_npz(file, {**arrays, STATE: state_array(with_format(state))})

    def remove_checkpoint(self) -> None:
        """Remove the checkpoint, if there is one."""
        (self.path / CHECKPOINT).unlink(missing_ok=True)

    def checkpoint_iteration(self) -> int:
        """The number of steps before the checkpoint; 0 without one."""
        state = self.load_checkpoint(lambda _: False)[1] if self.has_checkpoint else {}
        return int(state.get("iteration", 0))

    def load_checkpoint(
        self, wanted: Callable[[str], bool] = lambda name: True
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Load the arrays that are wanted by name, and the state; CRCs are checked."""
        path = self.path / CHECKPOINT
        if not self.has_checkpoint:
            raise InputError(f"{path}: no checkpoint to resume from; train without --resume")
        cure = "copy it again, or start the run again with --overwrite"
        with reading(path, "a checkpoint", cure):
            arrays = read_npz(path, lambda name: name == STATE or wanted(name))
            return arrays, state_of(path, arrays.pop(STATE))

    def save_model(self, gaussians: Gaussians, offset: ArrayLike, comments: Iterable[str] = ()) -> None:
        """Replace the finished model; see `ply.write_ply`."""
        write_ply(self.model_path, gaussians, offset, comments)

    @property
    def has_model(self) -> bool:
        """Whether the training is finished; its last evaluation may not be."""
        return self.model_path.is_file()

    @property
    def is_finished(self) -> bool:
        """Whether the run is finished with its report, which a part of a city does not have."""
        return self.has_model and ((self.path / REPORT).is_file() or self.read_options().get(PART_OF_CITY) is True)

    def write_report(self, html: str) -> Path:
        """Replace the report; returns its path."""
        with replacing(self.path / REPORT) as file:
            file.write(html.encode("utf-8", "backslashreplace"))
        return self.path / REPORT

    def check_model(self) -> None:
        """InputError if the training is not finished."""
        if not self.has_model:
            raise InputError(
                f"{self.model_path}: the run has no model yet; finish it with --resume, or a city with `clsplat merge`"
            )

    def load_model(self, offset: ArrayLike | None = None) -> Gaussians:
        """Load the finished model in the scene's local coordinates; see `ply.read_ply`."""
        self.check_model()
        return read_ply(self.model_path, offset)


def find_runs(path: str | Path) -> list[RunFolder]:
    """Find the runs in a folder: itself and those at most two levels below it, ordered by path;
    InputError if there are none."""
    path = Path(path)
    patterns = (OPTIONS, f"*/{OPTIONS}", f"*/*/{OPTIONS}")
    folders = sorted({file.parent for pattern in patterns for file in path.glob(pattern)})
    if not folders:
        raise InputError(
            f"{path}: holds no run ({OPTIONS} is missing here and two levels below); "
            "give folders that `clsplat train` wrote"
        )
    return [RunFolder.open(folder) for folder in folders]


def _line(record: dict[str, Any]) -> bytes:
    return (json.dumps(plain(record), allow_nan=False) + "\n").encode()


def _whole_lines(data: bytes) -> bytes:
    return data[: data.rfind(b"\n") + 1]


def write_exposures(folder: Path, responses: Mapping[str, Response]) -> None:
    """Write the responses of views by name into the folder of a run or a block, without rounding:
    the rows [M | t] of the transform, and the vignetting if there is any."""
    write_object(
        folder / EXPOSURES,
        {
            name: [
                *response.transform.ravel().tolist(),
                *(response.vignetting.tolist() if response.has_vignetting else []),
            ]
            for name, response in responses.items()
        },
        indent=0,
    )


def read_exposures(folder: Path) -> dict[str, Response] | None:
    """Read what `write_exposures` wrote, None without it; InputError if it is damaged."""
    path = folder / EXPOSURES
    if not path.is_file():
        return None
    rows = _rows(path, (TRANSFORM, TRANSFORM + VIGNETTING), "a file of exposures")
    return {
        name: Response(row.reshape(3, 4))
        if len(row) == TRANSFORM
        else Response(row[:TRANSFORM].reshape(3, 4), row[TRANSFORM:])
        for name, row in rows.items()
    }


def write_poses(run: Path, corrections: Mapping[str, Correction]) -> None:
    """Write the corrections of views by name, without rounding: six numbers each, the turn and the
    shift in world units. `run` is the folder."""
    write_object(
        run / POSES, {name: [*each.turn.tolist(), *each.shift.tolist()] for name, each in corrections.items()}, indent=0
    )


def read_poses(run: Path) -> dict[str, Correction]:
    """Read what `write_poses` wrote; InputError if it is damaged. A run without it has none."""
    if not (run / POSES).is_file():
        return {}
    rows = _rows(run / POSES, (POSE,), "a file of corrected poses")
    return {name: Correction(row[:3], row[3:]) for name, row in rows.items()}


def _rows(path: Path, counts: Sequence[int], what: str) -> dict[str, NDArray[np.float64]]:
    """The numbers of each view, of which there may be so many."""
    with reading(path, what, "copy it again, or train the run that wrote it again"):
        rows = object_of(read_regular(path))
        return {
            name: numbers(row, counts[-1] if len(row) != counts[0] else counts[0], name[:80])
            for name, row in rows.items()
        }
