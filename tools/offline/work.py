"""Which programs real work builds: small work of every kind runs here, and each build is noted."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np

import clsplat
from clsplat.cli.main import main
from clsplat.device import Device, Kernel, choose_device
from clsplat.device.kernel import DEVICE_SIZES, Defines
from clsplat.device.programs import words_of
from clsplat.io.photos.images import read_image, write_image
from clsplat.primitives.gather import scatter
from tools.bench.families import FAMILIES
from tools.bench.workloads import CityFrame, city

SCENE = Path(__file__).resolve().parents[2] / "data_samples" / "city"
# of the benchmarks' city: its size does not change what is built, but for what memory holds
GAUSSIANS, FEW, MANY, SMALL_BUFFER = 20_000, 2000, 60_000, 1 << 19
# a short training with growth and resets, and one with levels, by keys of the file of --config
EVENTFUL = {
    "densify_from": 5,
    "densify_every": 10,
    "densify_until": 40,
    "reset_every": 20,
    "grow_threshold": 5e-4,
    "sh_every": 12,
}
LEVELLED = {"rounds": 2, "densify_from": 0, "densify_every": 5, "convergence_rate": 0.02, "sphere_reach": 3.0}
TRAIN = "train SCENE -n 60 -r 8 -q -o"
# a command, and keys of the file of --config. FOLDER is a new one, with the folders that
# `make_inputs` makes
WORK: tuple[tuple[str, Mapping[str, Any]], ...] = (
    (f"{TRAIN} FOLDER/sig -r 4 --levels 2,1 --reproject on --exposure on --init sfm", LEVELLED),
    ("eval FOLDER/sig --align", {}),
    ("render FOLDER/sig -o FOLDER/rendered", {}),
    ("map FOLDER/sig -o FOLDER/map", {}),
    ("mesh FOLDER/sig -o FOLDER/mesh.ply", {}),
    ("export FOLDER/sig -o FOLDER/page.html", {}),
    ("film FOLDER/sig -o FOLDER/film --seconds 0.1 --fps 30 --size 96x64", {}),
    (f"{TRAIN} FOLDER/constant --schedule constant --exposure on --vignetting on --poses on --antialiased", EVENTFUL),
    (f"{TRAIN} FOLDER/depth --schedule constant --depth FOLDER/depths --poses on --robust on --sh-degree 1", EVENTFUL),
    ("train FOLDER/scene -n 60 -r 8 -q -o FOLDER/masked --schedule taming --batch 2", EVENTFUL),
    (f"{TRAIN} FOLDER/mcmc --schedule mcmc --max-gaussians 5000 --poses on", EVENTFUL),
    (f"{TRAIN} FOLDER/coded --schedule dash", {**EVENTFUL, "engine": "coded"}),
    (f"{TRAIN} FOLDER/numpy --schedule constant", {**EVENTFUL, "engine": "numpy"}),
    *(
        (
            f"{TRAIN} FOLDER/paged_{engine} --init FOLDER/many.ply --memory-budget {budget}MiB",
            {"sh_every": 12, "engine": engine, "eval_every": 25},
        )
        for engine, budget in (("device", 18), ("coded", 16))
    ),
    ("bench SCENE -r 4", {}),
    ("city SCENE -n 60 -r 4 -q -o FOLDER/city --grid 2x1 --least-views 3 --tree --exchanges 1", {"densify_from": 1000}),
    ("render FOLDER/city -o FOLDER/seen", {}),
)


@dataclass(frozen=True)
class Program:
    """A program that some work builds."""

    file: str  # of `cl`
    choices: Defines  # the constants of its build that no device decides
    # those that the work launches -> the size of their groups, as `Launch.group`
    kernels: Mapping[str, str]


def gather() -> list[Program]:
    """The programs that the work and the benchmarks build, in a fixed order.

    The group form runs here; choices do not depend on the form.
    """
    with recording() as built, TemporaryDirectory() as folder:
        run_all(Path(folder))
    return [Program(*key, built[key]) for key in sorted(built)]


@contextmanager
def recording() -> Iterator[dict[tuple[str, Defines], dict[str, str]]]:
    """Open each device in the group form; (file, choices) -> `Program.kernels`."""
    found: dict[tuple[str, Defines], dict[str, str]] = defaultdict(dict)
    opened, built = Device.__init__, Device._built

    def open_so(device: Device, *arguments: Any, **named: Any) -> None:
        opened(device, *arguments, **{**named, "form": "group"})

    def note(device: Device, kernel: Kernel, defines: Defines) -> Any:
        choices = tuple(
            pair for pair in sorted(defines) if pair[0] not in DEVICE_SIZES and pair[0] in words_of(kernel.file)
        )
        found[kernel.file, choices][kernel.function] = kernel.launches.group.group
        return built(device, kernel, defines)

    with patch.object(Device, "__init__", open_so), patch.object(Device, "_built", note):
        yield found


def run_all(folder: Path) -> None:
    """The commands of `WORK`, and every family of the benchmarks."""
    make_inputs(folder)
    for number, (command, keys) in enumerate(WORK):
        words = command.replace("SCENE", str(SCENE)).replace("FOLDER", str(folder)).split()
        if keys:
            file = folder / f"{number}.toml"
            file.write_text(
                "".join(f"{name} = {value!r}\n" for name, value in keys.items()).replace("'", '"'), encoding="utf-8"
            )
            words += ["--config", str(file)]
        run(words)
    draw_with_the_api()
    frame = CityFrame(choose_device(), GAUSSIANS)
    for family in FAMILIES.values():
        for function in family(frame).values():
            function()


def run(words: list[str]) -> None:
    """A command of clsplat, in this process; RuntimeError where it fails."""
    try:
        main(words)
    except SystemExit as ended:
        if ended.code:
            raise RuntimeError(f"clsplat {' '.join(words)} ended with {ended.code}") from None


def make_inputs(folder: Path) -> None:
    """FOLDER/depths: a flat depth map of each photo; scene: with a mask of each photo; many.ply:
    more gaussians than a small memory holds."""
    scene = folder / "scene"
    for new in (folder / "depths", scene, scene / "masks"):
        new.mkdir()
    for name in ("images", "sparse"):
        (scene / name).symlink_to(SCENE / name)
    for photo in sorted((SCENE / "images").iterdir()):
        mask = np.full_like(read_image(photo), 255)
        mask[:20] = 0
        np.save(folder / "depths" / f"{photo.stem}.npy", np.full(mask.shape[:2], 50, np.float32))
        write_image(scene / "masks" / f"{photo.stem}.png", mask)
    many, _ = city(MANY)
    many.rows["positions"][FEW:, 0] += 1e4  # so that a view sees a few of them
    clsplat.Gaussians(many.rows, many.sh_degree).save(folder / "many.ply")


def draw_with_the_api() -> None:
    """What only Python can ask for, and a frame whose pairs do not fit the device at once."""
    model, cameras = city(FEW, (96, 64))
    model.rows["log_scales"] += 2  # each in many tiles
    device = clsplat.Device()
    renderer = clsplat.Renderer(clsplat.Gaussians(model.rows, model.sh_degree), device)
    scatter(
        device, device.zeros((FEW, 3)), device.upload(np.arange(FEW, dtype=np.uint32)), device.zeros((FEW, 3))
    )  # where pages of one view come in several rounds
    device.largest_buffer = SMALL_BUFFER
    for features in (None, np.ones((model.count, 5), np.float32)):
        frame = renderer.forward(cameras[0], depth=True, features=features)
        renderer.backward(frame, np.ones_like(frame.image), pose=True)


def unbuilt(programs: list[Program]) -> list[str]:
    """Kernels that are declared for the group form, and that no work has launched."""
    for module in walk_packages(clsplat.__path__, "clsplat."):
        if not module.name.endswith("__main__"):
            import_module(module.name)
    built = {(each.file, kernel) for each in programs for kernel in each.kernels}
    return sorted(
        {
            str(kernel)
            for kernels in Kernel.declared.values()
            for kernel in kernels
            if kernel.launches.group and (kernel.file, kernel.function) not in built
        }
    )
