"""Reads a COLMAP reconstruction as a scene."""

import os
import signal
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import clsplat
from clsplat.errors import InputError
from clsplat.io.checks import check_photos, checked_scene
from clsplat.io.colmap_files import check_files, find_model
from clsplat.io.reason import clean

# far beyond what a healthy model takes: some 20 MB/s binary, 5 MB/s text
SECONDS = 120
BYTES_PER_SECOND = 1e6


def read_colmap(folder):
    """The scene of a folder with `images/` and a COLMAP model, binary or text, recentred.

    The model is looked for in sparse/0, sparse and the folder itself; only pinhole cameras are
    accepted. Every photo must be there in its camera's size (headers are read, not pixels).
    Raises InputError for whatever cannot be trained on.
    """
    folder = Path(folder)
    model, arrays = read_model(folder)
    if len(arrays["distorted"]):
        raise InputError(_undistort(folder, model, arrays["distorted"]))
    sources = [folder / "images" / name for name in arrays["names"]]
    scene = checked_scene(model, folder.resolve().name, arrays, sources)
    check_photos(scene.views)
    return replace(scene, path=folder).recentred()


def read_model(folder, may_be_empty=()):
    """(folder of its model, arrays of `colmap_child.model_arrays`) of a scene folder, wherever its
    photos are; may_be_empty: see `check_files`. Raises InputError where the model is damaged."""
    model = find_model(folder)
    check_files(model, may_be_empty)
    return model, _read_in_child(model)


def _undistort(folder, model, names):
    """Why a distorted model is refused, and two commands that undistort it."""
    images, whole = folder / "images", folder.resolve()
    target = whole.with_name(f"{whole.name}_undistorted")
    return (f"{model}: camera model {', '.join(names)} has lens distortion and clsplat wants "
            f"PINHOLE; undistort with `colmap image_undistorter --image_path '{images}' "
            f"--input_path '{model}' --output_path '{target}'` or `python -c \"import pycolmap; "
            f"pycolmap.undistort_images('{target}', '{model}', '{images}')\"`, then use {target}")


def _read_in_child(model):
    """The arrays of `colmap_child.model_arrays`; any way to fail becomes one InputError."""
    limit = SECONDS + sum(
        f.stat().st_size for f in model.iterdir() if f.is_file()) / BYTES_PER_SECOND
    with tempfile.TemporaryDirectory(prefix="clsplat-") as temporary:
        out = Path(temporary) / "model.npz"
        try:
            code, complaint = _run_child(model, out, limit)
        except subprocess.TimeoutExpired:
            raise InputError(f"{model}: pycolmap did not finish reading the model in {limit:.0f} "
                             "seconds; it is damaged: copy it again") from None
        if code != 0:
            cause = clean(_cause(code, complaint.decode(errors="replace")))
            if "No module named 'pycolmap'" in cause:
                raise InputError(f"{model}: reading it needs pycolmap; install it, or pack the "
                                 "scene into one .npz on a machine that has it")
            raise InputError(f"{model}: pycolmap cannot read the model ({cause}); "
                             "it is damaged: copy it again, or reconstruct the scene")
        with np.load(out, allow_pickle=False) as file:
            return {key: file[key] for key in file.files}


def _run_child(model, out, limit):
    """(exit code, what it said on stderr as bytes) of the child; ended after `limit` seconds."""
    root = str(Path(clsplat.__file__).parents[1])
    paths = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
    done = subprocess.run(
        [sys.executable, "-m", "clsplat.io.colmap_child", str(model), str(out)],
        env={**os.environ, "PYTHONPATH": paths}, stdin=subprocess.DEVNULL,
        check=False, capture_output=True, timeout=limit)
    return done.returncode, done.stderr


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
