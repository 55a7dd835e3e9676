"""Text models that other programs and editors leave: read, or refused with line and cure."""

import re
import shutil

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.scenes.read import read_scene
from tests.data.tiny_model import write_scene
from tests.io.shared_cases import CASES, needs_cases

TWO_LINES = "each image has two lines, of which the second may be empty; add the empty lines"


@needs_cases
def test_case_images_of_one_line():
    with pytest.raises(InputError, match=f"images.txt: line 3 is not the observations of image "
                                         f"000.jpg: {TWO_LINES}"):
        read_scene(CASES / "images_txt_one_line_each")


@needs_cases
def test_case_with_empty_lines_added(tmp_path):
    folder = shutil.copytree(CASES / "images_txt_one_line_each", tmp_path / "scene")
    path = folder / "sparse/0/images.txt"
    path.chmod(0o644)
    path.write_text(re.sub(r"(?m)^(\d.*)$", r"\1\n", path.read_text()))
    assert len(read_scene(folder).views) == 8


def lines_of(text, *, image=lambda line: line, observations=lambda line: line):
    """The lines of images.txt, changed; comments stay."""
    rows, number = [], 0
    for line in text.splitlines():
        if line.startswith("#"):
            rows.append(line)
            continue
        rows.append((observations if number % 2 else image)(line))
        number += 1
    return "\n".join(row for row in rows if row is not None) + "\n"


RIGHT, LAST = "right", "points3D.txt"
CASES_OF_IMAGES = {
    "no observations": (lambda t: lines_of(t, observations=lambda _: ""), RIGHT),
    "no lines of observations": (lambda t: lines_of(t, observations=lambda _: None), TWO_LINES),
    "only the last line is missing": (lambda t: t[:t.rstrip().rindex("\n") + 1], RIGHT),
    "one line is missing": (lambda t: "\n".join(
        line for n, line in enumerate(t.splitlines()) if n != 5) + "\n", TWO_LINES),
    "observations that are a name": (lambda t: lines_of(
        t, observations=lambda _: "1 2 photo.png"), TWO_LINES),
    "a name that is a number, without observations": (lambda t: lines_of(
        t, image=lambda line: line.rsplit(" ", 1)[0] + " 7", observations=lambda _: None),
        TWO_LINES),
    "Windows lines": (lambda t: t.replace("\n", "\r\n"), RIGHT),
    "a byte order mark": (lambda t: "\ufeff" + t, RIGHT),
    "tabs": (lambda t: t.replace(" ", "\t"), RIGHT),
    "blanks at the ends": (lambda t: t.replace("\n", "  \n"), RIGHT),
    "no comments": (lambda t: re.sub(r"(?m)^#.*\n", "", t), RIGHT),
    "each line twice as far": (lambda t: t.replace("\n", "\n\n"), "images.txt: line"),
    "empty lines at the end": (lambda t: t + "\n\n\n", RIGHT),
    "an empty line before the images": (lambda t: "\n" + t, RIGHT),
    "no pose": (lambda t: lines_of(t, image=lambda line: "1 1 a.png"), "an image has 3 fields"),
    "a word in a pose": (lambda t: lines_of(t, image=lambda line: line.replace(" ", " x", 1)),
                         "images.txt: line"),
    "nothing": (lambda t: "", "holds no images"),
}


@pytest.mark.one_in(3)
@pytest.mark.parametrize("name", CASES_OF_IMAGES)
def test_images(tmp_path, name):
    change, expected = CASES_OF_IMAGES[name]
    folder = write_scene(tmp_path / "town", text=True)
    whole = read_scene(folder)
    path = folder / "sparse/0/images.txt"
    path.write_bytes(change(path.read_text()).encode())
    if expected != RIGHT:
        with pytest.raises(InputError) as caught:
            read_scene(folder)
        assert expected in str(caught.value) and "\n" not in str(caught.value)
        return
    read = read_scene(folder)
    assert [view.name for view in read.views] == [view.name for view in whole.views]
    assert np.array_equal(read.points, whole.points)
