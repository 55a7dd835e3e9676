"""The readers under fuzz: how each one's valid files are made, and how a mutated one is read.

A seed is a small folder, {relative path: bytes}; `read` takes such a folder with one file mutated.
What a reader accepts must be usable, so `read` also looks at what it got: an assertion that fails
is a fault as much as a traceback.
"""

import json
from dataclasses import replace

import numpy as np

from clsplat.camera import Camera
from clsplat.cli.train import resumed_options
from clsplat.errors import InputError
from clsplat.gaussians import LEARNED
from clsplat.io.models.ply import read_ply, write_ply
from clsplat.io.photos.images import image_size, read_image, write_image
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.packed import write_packed
from clsplat.io.scenes.read import read_scene
from clsplat.options import from_toml, resolve
from clsplat.report.compare import compare, equality_tables, final_table, time_table
from clsplat.report.groups import grouped, read_runs
from clsplat.report.run import level_table, option_table, plan_table, score_table
from clsplat.scene import Scene, View
from clsplat.schedule import planned_steps
from clsplat.synth import geometry
from clsplat.synth.layout import city as plan_city
from clsplat.training import checkpoint
from tests.adversarial.fuzz import model_readers, place_readers, project_readers
from tests.adversarial.fuzz.reader import Reader, check, gaussians_like, usable
from tests.data import layouts
from tests.data.made_runs import made_run
from tests.data.tiny_model import reconstruction, write_scene


def _made_scenes(text):
    def make(folder):
        for points in (12, 7):
            made = reconstruction()
            for number in list(made.points3D)[points:]:
                made.delete_point3D(number)
            for extra in (True, False):  # the rigs and frames of newer versions, or none
                seed = write_scene(folder / f"{points}-{extra}", made, text)
                if not extra:
                    for path in (seed / "sparse/0").glob("*"):
                        if path.stem in ("rigs", "frames"):
                            path.unlink()
                yield seed
    return make


def _scene(folder):
    usable(read_scene(folder))


def _made_plys(folder):
    for number, (count, degree, sphere) in enumerate(((5, 0, True), (3, 1, False), (2, 3, False))):
        seed = folder / str(number)
        seed.mkdir()
        write_ply(seed / "model.ply", gaussians_like(count, degree), (1.5, 2.0, 3e6), ("made",),
                  sphere)
        yield seed
    head, _, _ = (folder / "0/model.ply").read_bytes().partition(b"end_header\n")
    rows = b"".join(b" ".join([b"0.25"] * head.count(b"property")) + b"\n" for _ in range(5))
    seed = folder / "text"
    seed.mkdir()
    (seed / "model.ply").write_bytes(
        head.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + rows)
    yield seed


def _ply(folder):
    check(read_ply(folder / "model.ply"))


def _made_images(folder):
    noise = np.random.default_rng(0).integers(0, 256, (24, 32, 4), dtype=np.uint8)
    for number, (name, channels) in enumerate(
            (("a.jpg", 3), ("a.png", 3), ("a.png", 4), ("a.png", 1), ("a.jpg", 1))):
        seed = folder / str(number)
        seed.mkdir()
        write_image(seed / name, noise[..., :channels], quality=60)
        (seed / name).rename(seed / "image")  # what it is must be told from its bytes
        yield seed


def _image(folder):
    width, height = image_size(folder / "image")
    pixels = read_image(folder / "image")
    assert pixels.shape == (height, width, 3) and pixels.dtype == np.uint8
    assert read_image((folder / "image").read_bytes(), (8, 6)).shape == (6, 8, 3)


def _made_packed(folder):
    random = np.random.default_rng(0)
    for number, (width, height, points) in enumerate(((16, 12, 9), (9, 16, 5))):
        seed = folder / str(number)
        seed.mkdir()
        write_image(photo := folder / f"{number}.png", random.integers(
            0, 256, (height, width, 3), dtype=np.uint8))
        views = tuple(View(f"photo_{at}.png", Camera(
            width, height, (20.0, 21.0), (width / 2, height / 2), np.eye(3), np.eye(3)[at]),
            photo.read_bytes()) for at in range(3))
        write_packed(Scene(
            "town", views, random.normal(size=(points, 3)), random.integers(
                0, 256, (points, 3), dtype=np.uint8), np.full(3, 5e5), folder,
            np.array([(0, 0), (0, 2), (1, 1)], np.int32)), seed / "town.npz")
        yield seed


def _packed(folder):
    usable(read_scene(folder / "town.npz"))


def _made_transforms(folder):
    scene = read_scene(write_scene(folder / "made"))
    whole, angled, parted, exported = (
        folder / kind for kind in ("whole", "angled", "parted", "exported"))
    for seed in (whole, angled, parted):
        table = layouts.write_transforms(seed, scene)
    (angled / "sparse_pc.ply").unlink()  # points are drawn, and suffixes tried
    layouts.write_json(angled / "transforms.json", {**layouts.camera_angle(scene), "frames": [
        {**frame, "file_path": frame["file_path"][:-4]} for frame in table["frames"]]})
    for number, part in enumerate(("train", "test")):
        layouts.write_json(parted / f"transforms_{part}.json", {
            **table, "frames": table["frames"][number::2]})
    layouts.write_export(exported, scene)
    return whole, angled, parted, exported


def _made_citygs(folder):
    scene = read_scene(write_scene(folder / "made"))
    layouts.write_citygs(folder / "town", scene, {"photo_1.png", "photo_3.png"})
    yield folder / "town"


def _made_checkpoints(folder):
    for degree in (0, 1):
        seed = folder / str(degree)
        gaussians = gaussians_like(4, degree)
        arrays = {f"row.{name}": values for name, values in gaussians.rows.items()}
        arrays |= {f"{kind}.{field.name}": 0 * gaussians.rows[field.name]
                   for kind in "mv" for field in LEARNED}
        arrays |= {"statistics.grad_norm_sum": np.zeros(4, np.float32),
                   "statistics.seen_count": np.zeros(4, np.uint32)}
        run = RunFolder.create(seed)
        run.write_options({"scene": "/data/city", "sh_degree": degree})
        run.save_checkpoint(arrays, {
            "fingerprint": "ab" * 32, "iteration": 7, "evaluated_at": None, "level": 2.0,
            "train_seconds": 1.5, "wall_seconds": 2.5, "kernel_bytes": 3, "pixel_pairs": 4,
            "initial_count": 4, "schedule": {"rounds": 1}, "budget": None,
            "skipped": {"total": 0, "closed": 0, "asked": 0}})
        yield seed


def _checkpoint(folder):
    run = RunFolder.open(folder)
    arrays, state = run.load_checkpoint()
    try:
        checkpoint.check_state(state)
        gaussians = checkpoint.gaussians_of(arrays, run.read_options()["sh_degree"])
    except (KeyError, ValueError) as error:  # as `loop.resume` has it
        raise InputError(f"{folder}: {error}") from None
    check(gaussians)
    assert state["iteration"] >= 0 and state["level"] >= 1


def _made_options(folder):
    for number, lines in enumerate((
            ("iterations = 500", "downscale = 2.5", "levels = [4.0, 2.0, 1.0]", "size = 'L'",
             "background = [0.0, 0.5, 1.0]", "sphere = false", "preset = \"release\""),
            ("# a comment", "time-budget = '10m'", "schedule = 'dash'", "seed = 3", "init = 'sfm'",
             "eval_at = [100, 200]", "antialiased = true", "grow-threshold = 1e-4"))):
        seed = folder / str(number)
        seed.mkdir()
        (seed / "run.toml").write_text("\n".join(lines) + "\n")
        yield seed


def _options(folder):
    options = resolve(from_toml(folder / "run.toml"), {})
    assert planned_steps(options, 30)[0] >= 1 and 0 <= options.sh_degree <= 3


def _made_run_folders(folder):
    for schedule in ("sig", "constant"):
        seed = folder / schedule
        for run in (made_run(seed / "a", schedule), made_run(seed / "b", "dash", 1)):
            metrics = run.path / "metrics.jsonl"
            rows = metrics.read_text().splitlines(keepends=True)
            kept = [row for row in rows if json.loads(row)["iteration"] % 2500 < 100]
            metrics.write_text("".join(kept))
        yield seed


def _run(folder):
    runs, _, _ = read_runs([folder])
    groups = grouped(runs)
    result = compare(groups)
    json.dumps(result, allow_nan=False)
    for table in (final_table(result), time_table(result), *equality_tables(groups)):
        assert table.text().encode() and table.html().encode()
    for run in runs:
        tables = (table(run.records) for table in (score_table, plan_table, level_table))
        assert all(table.html().encode() for table in tables if table)
        assert option_table(run.options).html().encode()
    resumed_options(runs[0].options, {})


def _made_geometry(folder):
    for number in range(2):
        seed = folder / str(number)
        seed.mkdir()
        city = plan_city((2, 1), number)
        few = replace(city, boxes=city.boxes[:9], kinds=city.kinds[:9], spheres=city.spheres[:4])
        geometry.save(few, seed / "geometry.json")
        yield seed


def _geometry(folder):
    city = geometry.load(folder / "geometry.json")
    away = geometry.distance(city, np.array([[0.0, 0, 5], [3, 1, 2]]))
    assert np.isfinite(away).all() and np.isfinite(city.extent).all()
    assert np.isfinite(city.bounds).all()


READERS = {
    "colmap": Reader(_made_scenes(False), _scene, files=(".bin",)),
    "colmap-text": Reader(_made_scenes(True), _scene, text=True, files=(".txt",)),
    "ply": Reader(_made_plys, _ply, files=(".ply",)),
    "image": Reader(_made_images, _image),
    "packed": Reader(_made_packed, _packed),
    "transforms": Reader(_made_transforms, _scene, text=True, files=(".json", ".ply")),
    "citygs": Reader(_made_citygs, _scene, files=(".bin",)),
    "checkpoint": Reader(_made_checkpoints, _checkpoint, files=(".npz",)),
    "options": Reader(_made_options, _options, text=True),
    "run": Reader(_made_run_folders, _run, text=True, files=("a/options.json", "a/metrics.jsonl")),
    "geometry": Reader(_made_geometry, _geometry, text=True),
    **model_readers.READERS,
    **place_readers.READERS,
    **project_readers.READERS,
}
