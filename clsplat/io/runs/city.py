"""The folder of a large scene's training: the only code with its file names.

Every file and every block appears whole or not at all, so that the same command can continue after
a kill at any moment.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError, reason
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import PARTIAL
from clsplat.io.fields import number
from clsplat.io.folders import new_folder
from clsplat.io.models.ply import START, start_of, write_ply
from clsplat.io.photos.undistort import FOLDER as UNDISTORTED
from clsplat.io.records import FORMAT_KEY, digest_of, object_of, read_object, with_format, write_object
from clsplat.io.regular import read_regular
from clsplat.io.runs.run import CITY, FILES, RunFolder, write_exposures
from clsplat.io.scenes.write import link_again, write_scene
from clsplat.partition.region import DAMAGED, Partition, Region
from clsplat.response import Response
from clsplat.scene import Scene

PARTITION, BLOCK, REGION = "partition.json", "block.json", "region.json"
PICTURE = "partition.png"  # the partition as an image
WINDOWS, VISITS = "windows", "visits"  # keys of region.json
EXCHANGES = "exchanges"  # key of block.json: after how many steps blocks exchange gaussians
DENSE = "dense"  # key of block.json: how many gaussians begin at dense points
OTHERS = "others"  # and: the numbers of the blocks with which it does so
INITIAL = "initial.ply"
STAGES = "stages.jsonl"  # when each stage of a city was done


class StageTime(NamedTuple):
    """A stage of a city that was done: what and where, when it began, in seconds since 1970, and
    how many it took."""

    name: str
    worker: str
    began: float
    seconds: float


class CityFolder:
    """A run folder that also has the coarse run, the partition and the blocks of a city. Errors are
    InputError.

    `coarse` and `joint` are the folders of the coarse run and of the joint training, `dense` and
    `joint_start` PLYs of the gaussians at dense points and at the start of the joint training.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.coarse = self.path / "coarse"
        self.undistorted, self.dense = self.path / UNDISTORTED, self.path / "dense.ply"
        self.joint, self.joint_start = self.path / "joint", self.path / "joint_start.ply"
        self.picture = self.path / PICTURE

    @property
    def has_record(self) -> bool:
        """Whether city.json exists."""
        return (self.path / CITY).is_file()

    @property
    def has_partition(self) -> bool:
        """Whether partition.json exists."""
        return (self.path / PARTITION).is_file()

    def write(self, record: dict[str, Any]) -> None:
        """Replace city.json by a dict, with at least the `fingerprint` of the whole scene."""
        write_object(self.path / CITY, with_format(record))

    def read(self, **kinds: type) -> dict[str, Any]:
        """Read city.json; `kinds` are the types of keys that are needed besides `fingerprint`."""
        return read_object(self.path / CITY, {"fingerprint": str, **kinds}, "give a folder that `clsplat city` wrote")

    def check_there(self) -> None:
        """InputError if the folder holds neither a city nor a coarse run, from which one begins."""
        if not (self.has_record or RunFolder(self.coarse).is_begun):
            raise InputError(f"{self.path}: holds no city ({CITY} is missing); give a folder that `clsplat city` wrote")

    def check_free(self) -> None:
        """InputError if a city cannot begin here, because the folder holds a run or a block, or
        other files but no coarse run."""
        present = sorted(path.name for path in self.path.iterdir()) if self.path.is_dir() else []
        foreign = [name for name in present if name in (*FILES, BLOCK, REGION)]
        if not RunFolder(self.coarse).is_begun:
            foreign += [name for name in present if name != self.coarse.name and name[0] != "."]
        if foreign:
            raise InputError(
                f"{self.path}: holds {foreign[-1]}, but no city ({CITY} is missing); choose another --output"
            )

    def add_stage(self, stage: StageTime) -> None:
        """Append a stage to those that were done."""
        with open(self.path / STAGES, "a", encoding="utf-8") as file:
            file.write(json.dumps(stage._asdict()) + "\n")

    def stages(self) -> list[StageTime]:
        """The stages that were done, in the order of their ends; without damaged lines, as nothing
        depends on them."""
        path, found = self.path / STAGES, []
        for line in read_regular(path).splitlines() if path.is_file() else ():
            with suppress(ValueError, TypeError):
                record = object_of(line)
                found.append(
                    StageTime(
                        str(record["name"]),
                        str(record["worker"]),
                        number(record["began"], "began"),
                        number(record["seconds"], "seconds"),
                    )
                )
        return found

    def write_partition(self, record: dict[str, Any]) -> None:
        """Replace partition.json by the record of a Partition."""
        write_object(self.path / PARTITION, record)

    def read_partition(self) -> dict[str, Any]:
        """Read partition.json."""
        return read_object(self.path / PARTITION, {}, f"make it with `clsplat partition {self.path}`")

    def partition(self, scene: Scene | None = None) -> Partition:
        """The partition; InputError if it is damaged, or not of this whole scene."""
        try:
            partition = Partition.from_record(self.read_partition())
            if scene is not None:
                partition.check_views(len(scene.views))
            return partition
        except DAMAGED as error:
            raise InputError(
                f"{self.path / PARTITION}: damaged ({reason(error)}); make it again "
                f"with `clsplat partition {self.path}`"
            ) from None

    def identity(self) -> dict[str, str]:
        """What the record of a block of this city must hold: `city`, the scene's fingerprint, and
        `partition`, the SHA-256 of partition.json."""
        self.read_partition()
        return {"city": self.read()["fingerprint"], "partition": digest_of(self.path / PARTITION)}

    def block(self, number: int) -> BlockFolder:
        """The folder of a block, whether it exists or not."""
        return BlockFolder(self.path / "blocks" / f"{number:03d}")

    def blocks(self) -> list[BlockFolder]:
        """The folders of the existing blocks, by number."""
        paths = [file.parent for file in self.path.glob(f"blocks/*/{BLOCK}") if file.parent.name.isdigit()]
        return [BlockFolder(path) for path in sorted(paths, key=lambda path: int(path.name))]

    def write_block(
        self,
        number: int,
        scene: Scene,
        views: Sequence[int] | NDArray[np.integer],
        region: Region,
        windows: Mapping[str, tuple[int, int, int, int]],
        initial: Gaussians,
        exposures: Mapping[str, Response] | None,
        options: Mapping[str, Any],
        identity: Mapping[str, Any],
        visits: Mapping[str, float] | None = None,
    ) -> BlockFolder:
        """Write a block as an ordinary scene folder, with links to photos.

        An existing block is left as it is; InputError if it is of another partition. `scene` is the
        whole, `views` are indices into its views, `windows` as for `Scene.cropped`, and `initial`
        gaussians in the scene's frame; `exposures` and `visits` are by the names of views, and
        `options` and `identity` are written to block.json.
        """
        block = self.block(number)
        record = json.loads(json.dumps({"number": number, **identity, "options": options}))
        if block.is_there:
            # one that an earlier format describes in the same words is the same
            varying = {START: "", FORMAT_KEY: 0}
            if {**block.read(), **varying} != {**record, **varying}:
                raise InputError(
                    f"{block.path}: holds a block of another partition, or with other "
                    "options; remove it, or choose another --output"
                )
            link_again(block.path, [scene.views[index] for index in views])
            return block
        part = scene.part(views)
        if not len(part.points):
            raise InputError(
                f"{block.path}: the {len(part.views)} views of block {number} see "
                "none of the sparse points; use fewer blocks"
            )
        left = block.path.with_name(block.path.name + PARTIAL)
        shutil.rmtree(left, ignore_errors=True)  # by a process that was killed
        with new_folder(block.path) as partial:
            write_scene(partial, part)
            write_object(partial / REGION, {**region.record(), WINDOWS: dict(windows), VISITS: dict(visits or {})})
            if exposures is not None:
                write_exposures(
                    partial, {view.name: exposures[view.name] for view in part.views if view.name in exposures}
                )
            write_ply(partial / INITIAL, initial, scene.offset, sphere=True)
            record[START] = digest_of(partial / INITIAL)
            write_object(partial / BLOCK, with_format(record))
        return block


class BlockFolder:
    """One block of a city: an ordinary scene folder with its region, the PLY of its initial
    gaussians and the folder of its run. Errors are InputError."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.initial, self.run = self.path / INITIAL, self.path / "run"

    @property
    def exchanges(self) -> list[int]:
        """After how many steps the block exchanges gaussians with others, ascending."""
        return list(self.read().get(EXCHANGES, []))

    @property
    def others(self) -> list[int]:
        """Numbers of the other blocks whose gaussians the block holds, ascending."""
        return list(self.read().get(OTHERS, []))

    def exchanged(self, number: int) -> Path:
        """The file of what the block owns at the exchange of this number, from 1."""
        return self.run / f"exchange_{number}.npz"

    def exchanges_there(self) -> list[int]:
        """Numbers of the exchanges whose files are there, ascending."""
        numbers = (path.stem.removeprefix("exchange_") for path in self.run.glob("exchange_*.npz"))
        return sorted(int(number) for number in numbers if number.isdecimal())

    @property
    def last_exchange(self) -> int:
        """The number of the last exchange to which the block has come; 0: none."""
        return max(self.exchanges_there(), default=0)

    def start(self) -> str:
        """SHA-256 of `initial` as it was written, which names the block in its models and
        exchanges; "" where neither that nor the file is there."""
        recorded = self.read().get(START) if self.is_there else None
        return recorded if isinstance(recorded, str) else digest_of(self.initial)

    def region(self) -> tuple[Region, dict[str, float]]:
        """The region of the block, and name of a view -> how often a training visits it."""
        path = self.path / REGION
        record = read_object(path, {}, "partition the city again")
        try:
            return Region.from_record(record), dict(record.get(VISITS, {}))
        except DAMAGED as error:
            raise InputError(f"{path}: damaged ({reason(error)}); partition the city again") from None

    def check_own(self, model: Path) -> None:
        """InputError for a PLY of another block's training. One of an earlier version does not
        record whose it is, and without `initial` there is nothing to compare with."""
        if (start := start_of(model)) and self.start() not in ("", start):
            raise InputError(
                f"{model}: is of another block, partition or city than {self.path}, "
                f"as its training did not begin at {self.initial}; put the block's "
                f"own there, or remove {self.run}, and run `clsplat city` again"
            )

    @property
    def is_there(self) -> bool:
        """Whether block.json exists, which is written last."""
        return (self.path / BLOCK).is_file()

    def read(self, *counts: str) -> dict[str, Any]:
        """Read block.json: at least `number`, `city`, `partition` and `options`, a dict, and these
        counts, which are integers."""
        kinds = {"number": int, "city": str, "partition": str, "options": dict}
        return read_object(
            self.path / BLOCK,
            kinds | dict.fromkeys(counts, int),
            "give a folder CITY/blocks/NNN that `clsplat partition` wrote",
        )

    def check(self) -> None:
        """InputError if the block lies, perhaps by a link, in another city than its own."""
        record, city = self.read(), CityFolder(self.path.absolute().parent.parent)
        # without one it is a block by itself, on another machine
        for key, value in city.identity().items() if city.has_record else ():
            if record[key] != value:
                raise InputError(
                    f"{self.path}: a block of another {key} than that of {city.path}; "
                    f"remove it, and run `clsplat partition {city.path}` again"
                )


def cropped_to_windows(scene: Scene, folder: Path) -> Scene:
    """The scene of its folder, with views cropped to the windows there if it is a block's."""
    path = folder / REGION
    if not path.is_file():
        return scene
    return scene.cropped(read_object(path, {WINDOWS: dict}, "partition the city again")[WINDOWS])
