"""What a case checks of its result, beyond what every case must hold."""

import re
from pathlib import Path

from PIL import Image

from tests.adversarial.prepared import prepared
from tests.adversarial.whole import fault


def model(run="out"):
    """A whole model with gaussians is there."""
    def check(folder: Path, _):
        path = folder / run / "point_cloud.ply" if (folder / run).is_dir() else folder / run
        if not path.is_file():
            return f"{run} has no model"
        return fault(path)
    return check


def same_model(run="out", name="run"):
    """The bytes of the model are those of a prepared run."""
    def check(folder, result):
        expected = (prepared() / name / "point_cloud.ply").read_bytes()
        path = folder / run / "point_cloud.ply"
        if not path.is_file():
            return f"{run} has no model"
        return None if path.read_bytes() == expected else f"{run}: the model has other bytes"
    return check


def no_model(run="out"):
    """No model was written."""
    def check(folder, _):
        return f"{run} has a model" if (folder / run / "point_cloud.ply").exists() else None
    return check


def pictures(count, where="out"):
    """So many pictures are there, and all decode."""
    def check(folder, _):
        found = sorted((folder / where).rglob("*.png"))
        if len(found) != count:
            return f"{len(found)} pictures in {where}, not {count}"
        return next((f"{path.name}: {broken}" for path in found if (broken := fault(path))), None)
    return check


def not_black(where="out"):
    """Some picture shows something."""
    def check(folder, _):
        found = sorted((folder / where).rglob("*.png"))
        if not any(max(Image.open(path).convert("L").getextrema()) > 8 for path in found):
            return "all pictures are black"
    return check


def missing(*names):
    """These files are not there."""
    def check(folder, _):
        there = [name for name in names if (folder / name).exists()]
        return f"is there: {', '.join(there)}" if there else None
    return check


def there(*names):
    """These files are there."""
    def check(folder, _):
        gone = [name for name in names if not (folder / name).exists()]
        return f"is missing: {', '.join(gone)}" if gone else None
    return check


def rows(output):
    """The numbers of an evaluation's table, or None."""
    found = re.findall(r"^(plain|colour-corrected)\s+([-\d.]+)\s+([-\d.]+)", output, re.MULTILINE)
    return found or None


def evaluated(folder, result):
    """The table of an evaluation was printed."""
    return None if rows(result.output) else "prints no table of PSNR and SSIM"


def has_test_views(count, run="out"):
    """The last evaluation was of so many views."""
    def check(folder, _):
        text = (folder / run / "metrics.jsonl").read_text()
        found = re.findall(r'"event": "eval".*"views": (\d+)', text)
        return None if found and int(found[-1]) == count else f"evaluated {found}, not {count}"
    return check
