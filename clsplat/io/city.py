"""The folder of a large scene's training: the only code that knows its file names.

Coarse run, partition, blocks and merged model meet here, on one machine or many. Every file
replaces itself whole, and a block appears whole or not at all, so a kill at any moment leaves what
the same command goes on from.
"""

import hashlib
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np

from clsplat.errors import InputError
from clsplat.io.atomic import PARTIAL
from clsplat.io.colmap_write import Tracks, write_colmap
from clsplat.io.exposures import EXPOSURES, read_exposures, write_exposures
from clsplat.io.packed import write_packed
from clsplat.io.ply import write_ply
from clsplat.io.reason import reason
from clsplat.io.records import object_of, write_object
from clsplat.io.run import CITY, FILES, RunFolder
from clsplat.partition.partition import Partition
from clsplat.partition.region import Region

PARTITION, BLOCK, REGION = "partition.json", "block.json", "region.json"
WINDOWS = "windows"  # key of region.json
REPLACES = "replaces"  # key of partition.json: the one before it, and which blocks it cut
INITIAL, PACKED = "initial.ply", "scene.npz"


class CityFolder:
    """What `clsplat city` keeps: a run folder like any other, with the coarse run, the partition,
    the blocks and the levels of detail in it. Errors are InputError.

    coarse, lod: folders; map, picture: the partition as GeoJSON and as an image.
    """

    def __init__(self, path):
        self.path = Path(path)
        self.coarse, self.lod = self.path / "coarse", self.path / "lod"
        self.map, self.picture = self.path / "partition.geojson", self.path / "partition.png"

    @property
    def has_record(self):
        return (self.path / CITY).is_file()

    @property
    def has_partition(self):
        return (self.path / PARTITION).is_file()

    def write(self, record):
        """Replace city.json: a dict for JSON, with at least `fingerprint`, of the whole scene."""
        write_object(self.path / CITY, record)

    def read(self, **kinds):
        """What `write` wrote; kinds: the types of keys that are needed besides `fingerprint`."""
        return _read(self.path / CITY, {"fingerprint": str, **kinds},
                     "give a folder that `clsplat city` wrote")

    def check_there(self):
        """InputError where the folder holds neither a city nor a coarse run, with which one begins.
        """
        if not (self.has_record or RunFolder(self.coarse).is_begun):
            raise InputError(f"{self.path}: holds no city ({CITY} is missing); give a folder that "
                             "`clsplat city` wrote")

    def check_free(self):
        """InputError where a city cannot begin here, as the folder holds a run or a block, or has
        no coarse run but other files, such as a scene's."""
        present = sorted(path.name for path in self.path.iterdir()) if self.path.is_dir() else []
        found = [name for name in present if name in (*FILES, BLOCK, REGION)]
        if not RunFolder(self.coarse).is_begun:
            found += [name for name in present if name != self.coarse.name and name[0] != "."]
        if found:
            raise InputError(f"{self.path}: holds {found[-1]}, but no city ({CITY} is missing); "
                             "choose another --output")

    def write_partition(self, record):
        """Replace partition.json by a Partition's record, a dict for JSON."""
        write_object(self.path / PARTITION, record)

    def read_partition(self):
        """What `write_partition` wrote."""
        path, cure = self.path / PARTITION, f"make it with `clsplat partition {self.path}`"
        record = _read(path, {}, cure)
        replaces = record.get(REPLACES)
        if replaces is not None and not (
                isinstance(replaces, dict) and type(replaces.get("partition")) is str
                and type(replaces.get("blocks")) is list):
            raise InputError(f"{path}: damaged ({REPLACES} is {str(replaces)[:20]!r}); remove it, "
                             f"and {cure}")
        return record

    def partition(self, scene=None):
        """The Partition, where given of this whole Scene; InputError where it is damaged."""
        try:
            partition = Partition.from_record(self.read_partition())
            if scene is not None:
                partition.check_views(len(scene.views))
            return partition
        except ValueError as error:
            raise InputError(f"{self.path / PARTITION}: damaged ({reason(error)}); make it again "
                             f"with `clsplat partition {self.path}`") from None

    def identity(self):
        """What a block must be of to belong here: `city`, the scene's fingerprint, and `partition`,
        the SHA-256 of partition.json."""
        self.read_partition()
        digest = hashlib.sha256((self.path / PARTITION).read_bytes()).hexdigest()
        return {"city": self.read()["fingerprint"], "partition": digest}

    def replace_partition(self, record, numbers):
        """`write_partition` where only the blocks `numbers` are others than before: their folders
        go, the rest become blocks of the new partition, now or when `adopt` is called again."""
        self.write_partition({**record, REPLACES: {
            "partition": self.identity()["partition"], "blocks": [int(n) for n in numbers]}})
        self.adopt()

    def adopt(self):
        """Finish `replace_partition`, if one was cut short."""
        replaces, identity = self.read_partition().get(REPLACES), self.identity()
        for block in self.blocks() if replaces else ():
            record = block.read()
            if record["partition"] != replaces["partition"]:
                continue
            if record["number"] in replaces["blocks"]:
                gone = block.path.with_name(block.path.name + PARTIAL)
                shutil.rmtree(gone, ignore_errors=True)
                os.rename(block.path, gone)
                shutil.rmtree(gone, ignore_errors=True)
            else:
                write_object(block.path / BLOCK, {**record, **identity})

    def block(self, number):
        """The BlockFolder of a block, there or not."""
        return BlockFolder(self.path / "blocks" / f"{number:03d}")

    def blocks(self):
        """The BlockFolders that are there, by number."""
        found = [file.parent for file in self.path.glob(f"blocks/*/{BLOCK}")
                 if file.parent.name.isdigit()]
        return [BlockFolder(path) for path in sorted(found, key=lambda path: int(path.name))]

    def write_block(self, number, scene, views, region, windows, initial, exposures, options,
                    identity):
        """Write a block as an ordinary scene folder, and return its BlockFolder.

        scene: the whole, as `read_scene` gave it; views: indices int[V] into its views; region:
        Region; windows: parts of photos, see `Scene.cropped`; initial: Gaussians in the scene's
        frame; exposures: name -> float[3, 4], or None;
        options: dict of TrainOptions; identity: dict for block.json, that of `identity()` with
        whatever is worth knowing. Photos are linked, or, where the scene is packed, copied. A block
        that is there already is left alone; one of another partition is an InputError.
        """
        block = self.block(number)
        record = json.loads(json.dumps({"number": number, **identity, "options": options}))
        if block.is_there:
            if block.read() != record:
                raise InputError(f"{block.path}: holds a block of another partition, or with other "
                                 "options; remove it, or choose another --output")
            _link_again(block.path, [scene.views[index] for index in views])
            return block
        part = scene.part(views)
        if not len(part.points):
            raise InputError(f"{block.path}: the {len(part.views)} views of block {number} see "
                             "none of the sparse points; use fewer blocks")
        partial = block.path.with_name(block.path.name + PARTIAL)
        try:
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir(parents=True)
            _write_scene(partial, part)
            write_object(partial / REGION, {**region.record(), WINDOWS: windows})
            if exposures is not None:
                write_exposures(partial / EXPOSURES, {
                    view.name: exposures[view.name] for view in part.views
                    if view.name in exposures})
            write_ply(partial / INITIAL, initial, scene.offset, sphere=True)
            write_object(partial / BLOCK, record)
            os.rename(partial, block.path)
        except BaseException as error:
            shutil.rmtree(partial, ignore_errors=True)
            if not isinstance(error, OSError):
                raise
            raise InputError(f"{block.path}: cannot be written ({error.strerror}); check that the "
                             "disk has space, and that nothing else has that name") from error
        return block


class BlockFolder:
    """One block of a city: an ordinary scene folder with its region, what it starts from and its
    run. Errors are InputError.

    initial: its first gaussians, PLY; run: the folder of its run.
    """

    def __init__(self, path):
        self.path = Path(path)
        self.initial, self.run = self.path / INITIAL, self.path / "run"

    @property
    def is_there(self):
        return (self.path / BLOCK).is_file()

    def read(self, *counts):
        """block.json: at least `number`, `city`, `partition` and `options`, a dict; counts: names
        of more keys that are whole numbers."""
        kinds = {"number": int, "city": str, "partition": str, "options": dict}
        return _read(self.path / BLOCK, kinds | dict.fromkeys(counts, int),
                     "give a folder CITY/blocks/NNN that `clsplat partition` wrote")

    def check(self):
        """InputError where the block lacks its region, or lies in a city that it is no block of,
        be it by a link."""
        record = self.read()
        if not (self.path / REGION).is_file():
            raise InputError(f"{self.path / REGION}: missing from the block; remove the block, and "
                             "run `clsplat partition` again")
        above = {path.parents[1] for path in (self.path.absolute(), self.path.resolve())
                 if len(path.parents) > 1}
        for city in map(CityFolder, sorted(above)):
            if not city.has_record:  # a block by itself, on another machine
                continue
            for key, value in city.identity().items():
                if record[key] != value:
                    raise InputError(
                        f"{self.path}: a block of another {key} than that of {city.path}; "
                        f"remove it, and run `clsplat partition {city.path}` again")


def attached(scene, folder):
    """The scene with the region, the windows and the exposures that its folder holds, if it is a
    block's."""
    folder = Path(folder)
    if not (folder / REGION).is_file():
        return scene
    path = folder / REGION
    try:
        record = _read(path, {WINDOWS: dict}, "partition the city again")
        region, windows = Region.from_record(record), record[WINDOWS]
        for view in scene.views:
            _check_window(view, windows.get(view.name))
    except ValueError as error:
        raise InputError(f"{path}: damaged ({reason(error)}); partition the city again") from None
    has_exposures = (folder / EXPOSURES).is_file()
    return replace(scene.cropped(windows), region=region,
                   exposures=read_exposures(folder / EXPOSURES) if has_exposures else None)


def _check_window(view, window):
    """ValueError for what is no part of a view's photo."""
    if window is None:
        return
    if type(window) is not list or [type(end) for end in window] != 4 * [int]:
        raise ValueError(f"the window of {view.name} is not four numbers")
    left, top, right, bottom = window
    if not (0 <= left < right <= view.camera.width and 0 <= top < bottom <= view.camera.height):
        raise ValueError(f"the window of {view.name} is not within its photo")


def _write_scene(folder, scene):
    """`scene` as a folder that `read_scene` reads, in original coordinates."""
    if isinstance(scene.views[0].source, bytes):
        write_packed(scene, folder / PACKED)
        return
    points = scene.points + scene.offset
    views = [replace(view, camera=view.camera.shifted(-scene.offset)) for view in scene.views]
    known = (np.zeros((0, 2), int) if scene.observations is None else scene.observations)
    pixels = np.empty((len(known), 2))
    for number, view in enumerate(scene.views):
        rows = np.flatnonzero(known[:, 1] == number)
        pixels[rows] = view.camera.project(scene.points[known[rows, 0]])[0]
    write_colmap(folder / "sparse" / "0", views, points, scene.colours,
                 Tracks(known[:, 0], known[:, 1], pixels))
    for view in views:
        link = folder / "images" / view.name
        link.parent.mkdir(parents=True, exist_ok=True)
        _link(view.source.resolve(), link)


def _link_again(folder, views):
    """Where the photos of a block were moved, link to where they are now."""
    for view in views:
        link = folder / "images" / view.name
        if isinstance(view.source, Path) and link.is_symlink() and not link.exists():
            try:
                link.unlink()
            except OSError as error:
                raise InputError(f"{link}: cannot be replaced ({error.strerror}); check that its "
                                 "folder may be written") from None
            _link(view.source.resolve(), link)


def _link(source, link):
    """A link to a file, or a copy where the file system has none."""
    try:
        link.symlink_to(source)
    except OSError:
        try:
            os.link(source, link)
        except OSError:
            shutil.copyfile(source, link)


def _read(path, kinds, cure):
    """The dict of a JSON file; InputError where it, or a key of `kinds`, is not as written."""
    try:
        record = object_of(path.read_bytes())
        for key, kind in kinds.items():
            if type(record.get(key)) is not kind:
                raise ValueError(f"{key} is {str(record.get(key))[:20]!r}")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {cure}") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: damaged ({reason(error)}); remove it, and {cure}") from None
    return record
