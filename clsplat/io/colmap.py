"""Reads a COLMAP reconstruction as a scene."""

import io
import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import clsplat
from clsplat.errors import InputError
from clsplat.io.checks import checked_scene
from clsplat.io.colmap_files import check_files, find_model, model_notes
from clsplat.io.reason import clean
from clsplat.io.regular import native
from clsplat.io.sources import IMAGES, checked_photos, photo_folder

# far beyond what a healthy model takes: some 20 MB/s binary, 5 MB/s text
SECONDS = 120
BYTES_PER_SECOND = 1e6


def read_colmap(folder, images=""):
    """The scene of a folder with `images/` and a COLMAP model, binary or text, recentred.

    The model is looked for in sparse/0, sparse, the folder itself and other sparse/N; only pinhole
    cameras are accepted. images: the photos' folder, see `photo_folder`. Every photo must be there,
    in its camera's size or, in another folder than images/, smaller by one factor for all (headers
    are read, not pixels). Raises InputError for whatever cannot be trained on.
    """
    folder = Path(folder)
    model, arrays = read_model(folder)
    photos = photo_folder(folder, images)
    if len(arrays["distorted"]):
        raise InputError(_undistort(folder, photos, model, arrays["distorted"]))
    sources = [photos / native(name) for name in arrays["names"]]
    scene = checked_scene(model, folder.resolve().name, arrays, sources)
    scene = replace(scene, path=folder, notes=tuple(model_notes(folder, model)))
    may_be_smaller = bool(images) or photos.name != IMAGES
    return checked_photos(scene, photos if may_be_smaller else None).recentred()


def read_model(folder, may_be_empty=()):
    """(folder of its model, arrays of `colmap_child.model_arrays`) of a scene folder, wherever its
    photos are; may_be_empty: see `check_files`. Raises InputError where the model is damaged."""
    model = find_model(folder)
    check_files(model, may_be_empty)
    return model, _read_in_child(model)


def _undistort(folder, images, model, names):
    """Why a distorted model is refused, and two commands that undistort it."""
    whole = folder.resolve()
    target = whole.with_name(f"{whole.name}_undistorted")
    return (f"{model}: camera model {', '.join(names)} has lens distortion and clsplat wants "
            f"PINHOLE; undistort with `colmap image_undistorter --image_path '{images}' "
            f"--input_path '{model}' --output_path '{target}'` or `python -c \"import pycolmap; "
            f"pycolmap.undistort_images('{target}', '{model}', '{images}')\"`, then use {target}")


def _read_in_child(model):
    """The arrays of `colmap_child.model_arrays`; any way to fail becomes one InputError."""
    limit = SECONDS + sum(
        f.stat().st_size for f in model.iterdir() if f.is_file()) / BYTES_PER_SECOND
    try:
        code, output, complaint = _run_child(model, limit)
    except subprocess.TimeoutExpired:
        raise InputError(f"{model}: pycolmap did not finish reading the model in {limit:.0f} "
                         "seconds; it is damaged: copy it again") from None
    if code != 0:
        cause = clean(_cause(code, complaint.decode(errors="replace")))
        if "No module named 'pycolmap'" in cause:
            raise InputError(f"{model}: reading it needs pycolmap; install it, or pack the scene "
                             "with `clsplat pack` on a machine that has it")
        if "MemoryError" in cause or "bad_alloc" in cause:
            raise InputError(f"{model}: the model needs more memory than there is ({cause}); "
                             "free some")
        raise InputError(f"{model}: pycolmap cannot read the model ({cause}); "
                         "it is damaged: copy it again, or reconstruct the scene")
    stream = io.BytesIO(output)
    return {name: np.lib.format.read_array(stream, allow_pickle=False)
            for name in json.loads(stream.readline())}


def _run_child(model, limit):
    """(exit code, standard output and error as bytes) of the child; ended after `limit` seconds.

    It gets this process's search path: `python -m` would import what lies in the current folder,
    which may be a scene from elsewhere. Results come through a pipe: no disk can be full.
    """
    root = str(Path(clsplat.__file__).parents[1])
    code = ("import sys; sys.path[:] = sys.argv[2:]; "
            "from clsplat.io.colmap_child import main; main(sys.argv[1])")
    done = subprocess.run(
        [sys.executable, "-I", "-c", code, str(model.resolve()), root, *filter(None, sys.path)],
        stdin=subprocess.DEVNULL, check=False, capture_output=True, timeout=limit)
    return done.returncode, done.stdout, done.stderr


def _cause(code, complaint):
    """One line from what a failed child left: its exception, a failed check, or its signal."""
    lines = [line.strip() for line in complaint.splitlines() if line.strip()]
    if code > 0 and lines:
        return lines[-1]
    checks = [line for line in lines if "Check failed" in line or "what():" in line]
    if checks:
        return checks[0]
    try:
        return f"it ended by {signal.Signals(-code).name}"
    except ValueError:
        return f"it ended with code {code}"
