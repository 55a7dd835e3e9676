"""Whether a file that clsplat wrote is whole, by its suffix; and what a folder holds."""

import hashlib
import json
import os
import zipfile
from pathlib import Path

import numpy as np
from PIL import Image
from plyfile import PlyData


def fault(path: Path) -> str | None:
    """What is wrong with a file, or None."""
    check = CHECKS.get(path.suffix.lower())
    if check is None:
        return None
    try:
        return check(path)
    except Exception as error:  # noqa: BLE001  (whatever a broken file raises)
        return f"{type(error).__name__}: {error}"


def _picture(path):
    with Image.open(path) as image:
        image.load()
        end = path.read_bytes()[-2:]
        if image.format == "JPEG" and end != b"\xff\xd9":
            return "is cut short"


def _ply(path):
    vertices = PlyData.read(str(path))["vertex"].data
    if not len(vertices):
        return "has no gaussians"
    if not np.isfinite(np.stack([vertices[axis] for axis in "xyz"])).all():
        return "has positions that are not finite"


def _json(path):
    json.loads(path.read_text())


def _lines(path):
    text = path.read_text()
    for line in text[:text.rfind("\n") + 1].splitlines():
        json.loads(line)


def _html(path):
    if not path.read_text().rstrip().endswith("</html>"):
        return "does not end with </html>"


def _archive(path):
    with zipfile.ZipFile(path) as archive:
        bad = archive.testzip()
    return bad and f"{bad} is damaged"


CHECKS = {".png": _picture, ".jpg": _picture, ".ply": _ply, ".json": _json, ".geojson": _json,
          ".jsonl": _lines, ".html": _html, ".npz": _archive}


def listing(folder: Path) -> dict[str, str]:
    """relative path -> digest of a file, target of a link, or "folder"; what may not be read, and
    what is neither, is named only."""
    found = {}
    for where, folders, files in os.walk(folder):
        for name in folders + files:
            path = Path(where, name)
            found[path.relative_to(folder).as_posix()] = _state(path)
    return found


def _state(path):
    if path.is_symlink():
        return f"link to {os.readlink(path)}"
    if path.is_dir():
        return "folder"
    if not path.is_file():
        return "special"
    return hashlib.sha256(path.read_bytes()).hexdigest()


def changes(before: dict[str, str], after: dict[str, str], allowed=()) -> list[str]:
    """What became of the files outside `allowed`: a line each. Empty folders count."""
    def may(name):
        return any(name == root or name.startswith(root + "/") for root in allowed)

    lost = [f"{name} is gone" for name in before if name not in after and not may(name)]
    changed = [f"{name} was changed" for name in before
               if name in after and after[name] != before[name] and not may(name)]
    new = [f"{name} is new" for name in after if name not in before and not may(name)]
    return lost + changed + new
