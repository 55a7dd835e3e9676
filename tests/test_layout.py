"""The checks of tests/layout.py: they find nothing here, and all that is wrong with a small made-up
checkout that is broken in every way."""

import pytest

from tests.layout import CHECKS, FORM_SWITCH, ROOT


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_the_house_is_in_order(check):
    found = list(check(ROOT))
    assert not found, "\n" + "\n".join(found)


# (file, its text, what the checks say) of a made-up checkout that is broken in every way
BROKEN = (
    ("pyproject.toml", "[project]\n", "[project] belongs in setup.cfg"),
    (
        "setup.cfg",
        "[options]\npackages = clsplat clsplat.bench clsplat.device clsplat.io "
        "clsplat.rendering\n[options.package_data]\nclsplat.cl = *.cl, item/*.cl, group/*.cl\n",
    ),
    ("notes.txt", "", "notes.txt: does not belong"),
    ("clsplat/__init__.py", "from clsplat.camera import x\n", "the package itself imports"),
    ("clsplat/attic.py", "", "'attic' has no layer", "attic.py: belongs into one of the packages"),
    (
        "clsplat/camera.py",
        "from clsplat.io.colmap import x\nimport clsplat.device.find\n"
        "def f():\n    import clsplat.io\nif TYPE_CHECKING:\n    import clsplat.io\n",
        *(f"camera.py:{line}: 'camera' is not above 'io'" for line in (1, 4, 6)),
        "camera.py:2: 'camera' must work without OpenCL",
        "camera.py:4: clsplat.io is imported in",
    ),
    ("clsplat/io/image_utils.py", "x = 1\n" * 401, "'utils' says nothing", "utils.py: 401 lines"),
    (
        "clsplat/apps/map.py",
        "import clsplat.schedule",
        "must do without 'schedule'",
        "package clsplat.apps is not listed",
    ),
    (
        "clsplat/bench/case.py",
        "import pyopencl as cl\nfrom tests.cases import x\nstep = Step(1)\nfrom scipy.sparse import x\n",
        "pyopencl belongs in clsplat/device/",
        "belongs in tests/",
        "Step is built in clsplat/training/session.py",
        "import scipy as a whole",
    ),
    (
        "clsplat/rendering/blend.py",
        "from ..errors import E\nform = device.form == 'item'",
        "leaves its package",
        "blend.py:2: asks for the form",
    ),
    ("clsplat/device/blend.py", "", "wants one clsplat/**/blend.py, there are 2"),
    ("tests/reference/blend.py", "from clsplat.camera import x", "must share no code"),
    ("tools/bench/families.py", "\ndef blend():\n    x\n", "sort.cl: tools/bench/*families.py does"),
    ("cl/blend.cl", 2 * FORM_SWITCH.format("blend.cl"), "cl/blend.cl: must include its forms"),
    ("cl/item/blend.cl", ""),
    ("cl/group/blend.cl", ""),
    ("tests/kernels/test_blend.py", ""),
    ("cl/item/scan.cl", "", "there is no cl/scan.cl"),
    ("cl/item/tiles.h", "", "the wheel lacks cl/item/tiles.h"),
    (
        "cl/sort.cl",
        "#if FORM_ITEM\n#endif",
        "cl/sort.cl: must include its forms",
        "wants one clsplat/**/sort.py, there are 0",
        "tests/reference/sort.py is missing",
        "tests/kernels/test_sort.py is missing",
    ),
)


def test_a_broken_house_is_noticed(tmp_path):
    """And nothing else is said of it."""
    for name, text, *_ in BROKEN:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    found = [line for check in CHECKS for line in check(tmp_path)]
    expected = [complaint for _, _, *complaints in BROKEN for complaint in complaints]
    for complaint in expected:
        assert sum(complaint in line for line in found) == 1, (complaint, found)
    assert len(found) == len(expected), found
