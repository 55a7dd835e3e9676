"""Features and matches on the device beside COLMAP's, on sets of photos.

    python -m tools.studies.features OUT PHOTOS ... [--keep photos]

Makes a scene of each folder of photos, once as `clsplat sfm` does and once with features and
matches by COLMAP on the CPU, in processes of their own, one after the other; pairs and mapping are
the same. A set that is done is not repeated. Where a folder `sparse` lies beside the photos, the
positions and turns of the cameras are compared with those of that model: 90 % differ by less than
what is given, positions by share of the distance of a camera from the middle of all.
"""

import argparse
import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap

from clsplat.io.ahead import called_ahead
from clsplat.report.page import Table
from clsplat.sfm import features, reconstruct
from clsplat.training.progress import SilentProgress
from tools.studies.study import keep, keeps, markdown, outermost

WAYS = ("clsplat", "COLMAP")
TITLE = "Features and matches beside COLMAP's"
HEAD = (
    "set",
    "features by",
    "CPU seconds",
    "host memory, GiB",
    "registered",
    "points",
    "mean track",
    "error, pixels",
    "turned by, degrees",
    "moved by, %",
)
LUMINANCE = (0.2126, 0.7152, 0.0722)
SHARE = 90  # per cent of the cameras


def colmap_features(path, photos, _device, most, _progress):
    """`extract_features` by COLMAP."""
    failures = {}
    with pycolmap.Database.open(path) as database:
        decoded = called_ahead(features._decoded, ((photo,) for photo in photos), 1, 2)
        for index, (photo, found) in enumerate(zip(photos, decoded)):
            if isinstance(found, str):
                failures[photo.name] = found
                continue
            options = pycolmap.FeatureExtractionOptions()
            options.use_gpu, options.num_threads = False, features.threads()
            options.sift.max_num_features, options.sift.first_octave = most, 0
            extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
            keypoints, data = features._features(Extractor(extractor), photo, *found)
            descriptors = pycolmap.FeatureDescriptors()
            descriptors.type, descriptors.data = pycolmap.FeatureExtractorType.SIFT, data
            database.write_keypoints(features.image_id(index), keypoints)
            database.write_descriptors(features.image_id(index), descriptors)
    return failures


class Extractor:
    """COLMAP's, called as `Sift` is."""

    def __init__(self, extractor):
        self.extractor = extractor

    def features(self, pixels, width, height):
        """float32[N, 4] and uint8[N, 128]."""
        bitmap = pycolmap.Bitmap.from_array((pixels @ LUMINANCE + 0.5).astype(np.uint8))
        if width > bitmap.width:
            bitmap.rescale(width, height)
        found, described = self.extractor.extract(bitmap)
        return (
            np.array(pycolmap.keypoints_to_matrix(found), np.float32).reshape(-1, 4),
            np.array(described.data, np.uint8).reshape(-1, 128),
        )


def colmap_matches(path, pairs, _device, _progress):
    """`match_pairs` by COLMAP."""
    options, geometry = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    options.use_gpu, geometry.ransac.random_seed = False, 0
    listed = pycolmap.ImportedPairingOptions()
    listed.match_list_path = path.with_name("pairs.txt")
    listed.match_list_path.write_text(
        "".join(f"{features.image_name(first)} {features.image_name(second)}\n" for first, second in pairs)
    )
    pycolmap.match_image_pairs(path, options, listed, geometry, pycolmap.Device.cpu)


def scene(photos, output, way):
    """Make a scene of photos."""
    if way == "COLMAP":
        features.extract_features, reconstruct.match_pairs = colmap_features, colmap_matches
    reconstruct.reconstruct(photos, output, reconstruct.SfmOptions(), SilentProgress())


def differences(ours, theirs):
    """How cameras differ that two models have: turns in degrees, and shares of the distance from
    the middle, `SHARE` per cent of them."""
    places, turns = [], []
    other = {Path(image.name).name: image for image in theirs.images.values() if image.has_pose}
    for image in ours.images.values():
        match = other.get(Path(image.name).name)
        if image.has_pose and match is not None:
            places.append((image.projection_center(), match.projection_center()))
            turns.append((image.cam_from_world().rotation.matrix(), match.cam_from_world().rotation.matrix()))
    ours, theirs = np.array(places).swapaxes(0, 1)
    moved = pycolmap.estimate_sim3d(ours, theirs)
    there = ours @ (moved.scale * moved.rotation.matrix().T) + moved.translation
    away = np.linalg.norm(there - theirs, axis=1)
    extent = np.sqrt(((theirs - theirs.mean(axis=0)) ** 2).sum(axis=1).mean())
    angles = [
        np.degrees(np.arccos(np.clip((np.trace(first @ moved.rotation.matrix().T @ second.T) - 1) / 2, -1, 1)))
        for first, second in turns
    ]
    return np.percentile(angles, SHARE), 100 * np.percentile(away, SHARE) / extent


def measure(photos, output, way):
    """The row of a set and a way, which is kept beside its scene."""
    kept = output.with_suffix(".json")
    if kept.exists():
        return json.loads(kept.read_text())
    child = subprocess.Popen([sys.executable, "-m", "tools.studies.features", str(output), str(photos), "--way", way])
    _, status, used = os.wait4(child.pid, 0)
    if status:
        raise SystemExit(f"{photos}, {way}: failed")
    model = pycolmap.Reconstruction(output / "sparse" / "0")
    record = json.loads((output / "sfm.json").read_text())
    given = sorted(photos.parent.glob("sparse/**/images.*"))
    turned, moved = differences(model, pycolmap.Reconstruction(given[0].parent)) if given else (None, None)
    row = [
        photos.parent.name if photos.name == "images" else photos.name,
        way,
        round(used.ru_utime + used.ru_stime),
        used.ru_maxrss / 2**20,
        f"{record['registered']} of {record['photos']}",
        record["points"],
        record["mean_track_length"],
        record["reprojection_error_pixels"],
        turned,
        moved,
    ]
    kept.write_text(json.dumps(row))
    return row


def text(value):
    """A cell."""
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else (f"{value:,}" if isinstance(value, int) else value)


def main(argv):
    """Measure all sets, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("photos", type=Path, nargs="+")
    parser.add_argument("--only", choices=WAYS, help="measure one way")
    parser.add_argument("--way", choices=WAYS, help=argparse.SUPPRESS)  # of a process of its own
    keeps(parser)
    args = parser.parse_args(argv)
    if args.way:
        scene(args.photos[0], args.output, args.way)
        return
    args.output.mkdir(parents=True, exist_ok=True)
    rows = []
    for photos in args.photos:
        name = "_".join(photos.resolve().parts[-2:])
        for way in [args.only] if args.only else WAYS:
            rows.append(measure(photos, args.output / f"{name}_{way}", way))
            print(*rows[-1], flush=True)
    table = Table(TITLE, HEAD, [[text(value) for value in row] for row in rows], numbers=range(2, len(HEAD)))
    print(markdown(table))
    keep(args.keep, [table], f"python -m tools.studies.features {shlex.join(argv)}", "two CPU cores")


if __name__ == "__main__":
    outermost(main)
