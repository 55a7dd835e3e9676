"""The house rules that a program can check: layers, import walls, the name rhyme, names and sizes.

Each check takes the root of a checkout and yields one line a violation.
"""

import ast
import configparser
import re
from functools import cache
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parents[1]

TOP_LEVEL = {
    "setup.cfg",
    "pyproject.toml",
    "README.md",
    "LICENSE",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "CITATION.cff",
    "MANIFEST.in",
    "clsplat",
    "cl",
    "tools",
    "tests",
    "data_samples",
    "docs",
}
BUILD_OUTPUTS = {"out", "build", "dist", "clsplat.egg-info", "__pycache__"}

# a module imports from its own package and from the lines above its own
LAYERS = (
    {"constants", "errors"},
    {"device"},
    {"primitives"},
    {"camera", "config", "georeference"},
    {"placement", "response"},
    {"gaussians", "scene"},
    {"covisibility"},
    {"partition"},
    {"io"},
    {"edit", "rendering", "sfm", "stereo"},
    {"loss", "mesh", "optimise"},
    {"densify"},
    {"schedule"},
    {"options"},
    {"evaluation"},
    {"report"},
    {"training"},
    {"estimate"},
    {"cities"},
    {"api"},
    {"apps", "bench"},
    {"cli"},
    {"__main__"},
)
NOUNS = {
    "__init__",
    "__main__",
    "camera",
    "constants",
    "errors",
    "gaussians",
    "georeference",
    "options",
    "response",
    "scene",
}
LAYER_OF = {unit: number for number, units in enumerate(LAYERS) for unit in units}

# tested without OpenCL, though they stand above the device layer
NO_DEVICE = {
    "camera",
    "config",
    "options",
    "gaussians",
    "georeference",
    "placement",
    "response",
    "scene",
    "covisibility",
    "schedule",
    "partition",
    "report",
}

# rooms that use what the public API is made of, and these; `training` for the page that shows one
USED_BY_APPS = {
    "camera",
    "constants",
    "device",
    "edit",
    "errors",
    "evaluation",
    "gaussians",
    "georeference",
    "io",
    "mesh",
    "partition",
    "placement",
    "rendering",
    "report",
    "scene",
    "training",
}

# package -> the only folders that may import it
WALLS = {
    "pyopencl": ("clsplat/device/",),
    "pycolmap": ("clsplat/io/", "clsplat/sfm/", "tools/studies/"),
    "rasterio": ("clsplat/apps/geotiff.py", "tools/"),
    **dict.fromkeys(("laspy", "lazrs", "pxr", "zstandard", "PIL", "pillow_heif", "rawpy"), ("clsplat/io/",)),
    "pyproj": ("clsplat/io/georeference/crs.py",),
    "OpenImageIO": ("clsplat/io/", "clsplat/evaluation/metrics.py"),
    "onnxruntime": ("clsplat/evaluation/metrics.py",),
    "click": ("clsplat/cli/",),
    "skimage": ("clsplat/apps/",),
    **dict.fromkeys(("dask", "distributed"), ("clsplat/cities/cluster.py",)),
    "matplotlib": ("clsplat/report/figures/", "tools/"),
    "tests": ("tests/", "tools/studies/"),  # the wheel carries clsplat/, not the tests
}

# imports inside functions: folder -> packages (None: any). Start-up is worth it in these only
FUNCTION_IMPORTS = {
    "clsplat/": {"importlib"},
    "clsplat/cli/": None,
    "clsplat/__main__.py": None,
    "clsplat/io/": {"laspy", "lazrs", "numpy", "pxr", "pycolmap", "OpenImageIO", "pyproj", "zstandard", "PIL"},
    "clsplat/evaluation/": {"OpenImageIO", "onnxruntime"},
    "clsplat/cities/cluster.py": {"distributed"},
}  # an extra, seldom asked for

# what is composed of the options of all rooms: lower rooms may name its type, and no more
COMPOSED = {"options"}

# what a training consists of is put together in one place, for estimates and benchmarks too
SESSION, BUILT_BY_A_SESSION = "clsplat/training/session.py", {"Step"}

FORBIDDEN_WORDS = {"util", "utils", "helper", "helpers", "common", "misc", "manager"}
LONGEST_FILE, LONGEST_CODE = 400, 300  # lines, and without comments and docstrings
FORM_SWITCH = '#if FORM_ITEM\n#include "item/{0}"\n#else\n#include "group/{0}"\n#endif\n'
parsed = cache(lambda path: ast.parse(path.read_text("utf-8")))  # for several checks


def sources(root, *folders, suffixes=(".py",)):
    """(path relative to root with slashes, Path) of the source files under folders."""
    for folder in folders:
        for path in sorted((root / folder).rglob("*")):
            if path.suffix in suffixes:
                yield path.relative_to(root).as_posix(), path


@cache
def imports(path):
    """(line, dotted name, place) of each import; relative ones as ".name". The place is "function",
    "types" (for the type checker alone) or "module"."""

    def visit(node, place):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name, place
        elif isinstance(node, ast.ImportFrom):
            dots, module = "." * node.level, node.module or ""
            if module == "clsplat":  # `from clsplat import camera` is about clsplat.camera
                for alias in node.names:
                    yield node.lineno, f"clsplat.{alias.name}", place
            else:
                yield node.lineno, dots + module, place
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            place = "function"
        elif isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            place = "types"
        for child in ast.iter_child_nodes(node):
            if not isinstance(child, ast.expr):  # of which none imports
                yield from visit(child, place)

    return tuple(visit(parsed(path), "module"))


def unit_of(root, name):
    """The file or folder of clsplat/ that a path or a dotted import belongs to, or None."""
    parts = re.split(r"[./]", name)
    if parts[0] != "clsplat" or len(parts) < 2 or parts[1] == "__init__":
        return None
    known = parts[1] in LAYER_OF
    exists = (root / "clsplat" / parts[1]).is_dir() or (root / f"clsplat/{parts[1]}.py").exists()
    return parts[1] if known or exists else None  # else an attribute such as clsplat.__version__


def layers(root):
    for name, path in sources(root, "clsplat"):
        unit = unit_of(root, name)
        if unit is not None and unit not in LAYER_OF:
            yield f"{name}: '{unit}' has no layer; give it one in tests/layout.py"
            continue
        for line, target, place in imports(path):
            other = unit_of(root, target)
            if target.startswith(".."):
                yield f"{name}:{line}: '{target}' leaves its package; import by full name"
            elif other is not None and other not in LAYER_OF:
                yield f"{name}:{line}: imports '{other}', which has no layer"
            elif other is None or other == unit:
                continue
            elif place == "types" and (unit is None or other in COMPOSED):
                continue
            elif unit is None:
                yield f"{name}:{line}: the package itself imports '{other}'"
            elif LAYER_OF[other] >= LAYER_OF[unit]:
                yield f"{name}:{line}: '{unit}' is not above '{other}'"
            elif unit == "apps" and other not in {*USED_BY_APPS, "api"}:
                yield f"{name}:{line}: 'apps' must do without '{other}'"
            elif unit in NO_DEVICE and other in ("device", "primitives"):
                yield f"{name}:{line}: '{unit}' must work without OpenCL"


def corridor(root):
    """Only the nouns that everybody speaks of stand outside a room."""
    for path in sorted((root / "clsplat").glob("*.py")):
        if path.stem not in NOUNS:
            yield f"clsplat/{path.name}: belongs into one of the packages"


def walls(root):
    for name, path in sources(root, "clsplat", "tools"):
        for line, target, _ in imports(path):
            allowed = WALLS.get(target.split(".")[0])
            if allowed is not None and not name.startswith(allowed):
                yield f"{name}:{line}: {target} belongs in {' and '.join(allowed)}"
    for name, path in sources(root, "tests/reference"):
        for line, target, _ in imports(path):
            if target.split(".")[0] == "clsplat":
                yield f"{name}:{line}: the reference must share no code with what it checks"


def function_imports(root):
    for name, path in sources(root, "clsplat"):
        for line, target, place in imports(path):
            # `import scipy` loads each part where it is first used
            if target.startswith("scipy.") and place == "module":
                yield f"{name}:{line}: import scipy as a whole, not {target}"
            if place != "function":
                continue
            allowed = [packages for folder, packages in FUNCTION_IMPORTS.items() if name.startswith(folder)]
            if not any(packages is None or target.split(".")[0] in packages for packages in allowed):
                yield f"{name}:{line}: {target} is imported inside a function"


def families(root):
    """The files of cl/ itself."""
    return [path for _, path in sources(root, "cl", suffixes=(".cl",)) if path.parent.name == "cl"]


BENCHMARKS = "tools/bench/*families.py"


def homes(root, family):
    """The modules that may declare a family's kernels: there should be one."""
    return [
        name for name, home in sources(root, "clsplat") if home.stem == family and not name.startswith("clsplat/cli/")
    ]


def rhyme(root):
    for path in families(root):
        stem, found = path.stem, len(homes(root, path.stem))
        if found != 1:
            yield f"cl/{stem}.cl: wants one clsplat/**/{stem}.py, there are {found}"
        for verse in (f"tests/reference/{stem}.py", f"tests/kernels/test_{stem}.py"):
            if not (root / verse).exists():
                yield f"cl/{stem}.cl: {verse} is missing"
        if not any(f"\ndef {stem}(" in file.read_text("utf-8") for file in root.glob(BENCHMARKS)):
            yield f"cl/{stem}.cl: {BENCHMARKS} does not time it"


def kernel_forms(root):
    """A family's two forms are files of its name in cl/item and cl/group, which it includes."""
    known = {path.stem for path in families(root)}
    for folder in ("item", "group"):
        for name, path in sources(root, f"cl/{folder}", suffixes=(".cl",)):
            if path.stem not in known:
                yield f"{name}: there is no cl/{path.stem}.cl"
    for path in families(root):
        has = [(root / "cl" / form / path.name).exists() for form in ("item", "group")]
        switches = path.read_text().count("FORM_ITEM")
        if has[0] != has[1]:
            yield f"cl/{path.name}: has one form only"
        elif switches != has[0] or has[0] and FORM_SWITCH.format(path.name) not in path.read_text():
            yield f"cl/{path.name}: must include its forms, and know them by nothing else"


def form_branches(root):
    """Only the device layer asks for a kernel's form: what differs is data (device.Forms)."""
    for name, path in sources(root, "clsplat"):
        if name.startswith("clsplat/device/") or not re.search(r"\bform\b|\bitem\b|\bgroup\b", path.read_text("utf-8")):
            continue
        for node in ast.walk(parsed(path)):
            asked = (
                [node.left, *node.comparators]
                if isinstance(node, ast.Compare)
                else [node.slice]
                if isinstance(node, ast.Subscript)
                else []
            )
            if any(
                isinstance(each, ast.Attribute)
                and each.attr == "form"
                or isinstance(each, ast.Constant)
                and each.value in ("item", "group")
                and isinstance(node, ast.Compare)
                for each in asked
            ):
                yield f"{name}:{node.lineno}: asks for the form; declare it as device.Forms"


def sizes(root):
    for name, path in sources(root, "clsplat", "cl", "tools", "tests", suffixes=(".py", ".cl", ".h")):
        count = len(path.read_text().splitlines())
        if count > LONGEST_FILE and (path.suffix != ".py" or real_lines(path) > LONGEST_CODE):
            yield f"{name}: {count} lines, more than {LONGEST_FILE}"


def real_lines(path):
    """The number of lines without blanks, comments and docstrings."""
    tree, docs = parsed(path), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            docs.update(range(node.lineno, node.end_lineno + 1))
    return sum(
        bool(line.strip()) and not line.lstrip().startswith("#") and number not in docs
        for number, line in enumerate(path.read_text("utf-8").splitlines(), 1)
    )


def names(root):
    for name, _ in sources(root, "clsplat", "cl", "tools", "tests", suffixes=(".py", ".cl", ".h")):
        for word in re.split(r"[/_.]", name):
            if word in FORBIDDEN_WORDS:
                yield f"{name}: '{word}' says nothing; name the content"


def packaging(root):
    """setup.cfg lists every package and kernel, or the wheel lacks it though the checkout works."""
    setup = configparser.ConfigParser()
    setup.read(root / "setup.cfg")
    listed = set(setup.get("options", "packages", fallback="").split())
    for folder in sorted({path.parent for _, path in sources(root, "clsplat")}):
        package = folder.relative_to(root).as_posix().replace("/", ".")
        if package not in listed:
            yield f"setup.cfg: package {package} is not listed"
    patterns = setup.get("options.package_data", "clsplat.cl", fallback="").split(", ")
    for path in sorted(path for path in (root / "cl").rglob("*") if path.is_file()):
        name = path.relative_to(root / "cl").as_posix()
        if not any(
            PurePosixPath(name).match(pattern) and name.count("/") == pattern.count("/") for pattern in patterns
        ):
            yield f"setup.cfg: the wheel lacks cl/{name}"


def top_level(root):
    for path in sorted(root.iterdir()):
        if path.name not in TOP_LEVEL | BUILD_OUTPUTS and not path.name.startswith("."):
            yield f"{path.name}: does not belong at the top level"
    pyproject = (root / "pyproject.toml").read_text()
    for section in re.findall(r"^\[(.+)\]", pyproject, re.MULTILINE):
        if section != "build-system":
            yield f"pyproject.toml: [{section}] belongs in setup.cfg"


def sessions(root):
    called = re.compile("|".join(BUILT_BY_A_SESSION))
    for name, path in sources(root, "clsplat"):
        for node in ast.walk(parsed(path)) if called.search(path.read_text("utf-8")) else ():
            if (
                isinstance(node, ast.Call)
                and isinstance(node.func, ast.Name)
                and node.func.id in BUILT_BY_A_SESSION
                and name != SESSION
            ):
                yield f"{name}:{node.lineno}: {node.func.id} is built in {SESSION} only"


CHECKS = (
    layers,
    corridor,
    walls,
    sessions,
    function_imports,
    rhyme,
    kernel_forms,
    form_branches,
    sizes,
    names,
    packaging,
    top_level,
)
