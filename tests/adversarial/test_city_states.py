"""Cities that were damaged, moved about or half edited: one line says what is wrong."""

import dataclasses
import json
import shutil

import numpy as np
import pytest

from clsplat.city import cut, stages
from clsplat.cli.main import main
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.runs.city import CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import fingerprint, read_scene
from clsplat.options import resolve
from clsplat.partition.options import PartitionOptions
from tests.data.tiny_training import CITY

pytestmark = pytest.mark.slow  # each reads a city that was made for it

NEEDS = {"exposure": "off", "sh_degree": 1, "levels": [1.0]}
HUGE = "1" + "0" * 400


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A finished city of two blocks that no device has trained."""
    folder, scene = CityFolder(tmp_path_factory.mktemp("states") / "city"), read_scene(CITY)
    options = resolve({}, {"iterations": 20, "downscale": 8.0, "sh_degree": 1, "exposure": "off"})
    stages.begin(folder, scene, options)
    gaussians = Gaussians.from_points(scene.points, scene.colours, 1)
    finish(folder.coarse, scene, stages.coarse_options(options, scene), gaussians)
    partition, counts = cut.cut_into_blocks(folder, scene, options, PartitionOptions(
        "blockgs", (2, 1), least_views=1), None)
    cut.draw(folder, partition, scene, counts)
    for block in folder.blocks():
        finish(block.run, scene, options, gaussians)
    return folder.path


def finish(path, scene, options, gaussians):
    run = RunFolder.create(path)
    run.write_options({"scene": scene.path, **dataclasses.asdict(options), "decisions": NEEDS,
                       "fingerprint": fingerprint(scene)})
    run.log({"event": "plan", "iteration": 20, "train_seconds": 1.0, "wall_seconds": 2.0})
    run.save_model(gaussians, scene.offset)
    run.write_report("")


@pytest.fixture
def city(made, tmp_path):
    return shutil.copytree(made, tmp_path / "city", symlinks=True)


def command(capsys, *words):
    """(exit code, what was said on stderr) of a command line."""
    with pytest.raises(SystemExit) as ended:
        main([*map(str, words)])
    return ended.value.code, capsys.readouterr().err


def refused(capsys, *words):
    code, error = command(capsys, *words)
    assert code == 2, (words, code, error)
    assert error.startswith("error: ") and error.count("\n") == 1, error
    return error


def edited(path, **changes):
    """Set keys of a JSON file; None removes one, raw text goes in as it is."""
    record = json.loads(path.read_text())
    for key, value in changes.items():
        record[key] = value
        if value is None:
            del record[key]
    path.write_text(json.dumps(record).replace('"HUGE"', HUGE))


TEXTS = ["", "{", "[]", "null", "3", '{"a": NaN}', '{"a": 1e999}', "[" * 100_000, "\xff",
         '{"fingerprint": 3}', '{"fingerprint": "' + "0" * 64 + '"}']
NAMES = ["city.json", "partition.json", "coarse/options.json", "blocks/000/block.json"]


@pytest.mark.parametrize("name, text", [
    pytest.param(name, text, id=f"{name}-{text[:12]!r}") for i, text in enumerate(TEXTS)
    for name in (NAMES[i % 4], NAMES[(i + 1) % 4])])
def test_a_file_of_nonsense_is_named(city, capsys, name, text):
    (city / name).write_text(text, encoding="latin-1")
    for words in (("partition", city), ("merge", city)):
        if (name, words[0]) != ("coarse/options.json", "merge"):  # which does not read it
            assert str(city) in refused(capsys, *words)


EDITS = [
    ("city.json", {"options": [1]}, "options is '[1]'"),
    ("city.json", {"options": None}, "options is 'None'"),
    ("city.json", {"options": {"near": 1e90}}, "city.json: option 'near' expects at most"),
    ("city.json", {"options": {"nope": 1}}, "city.json: unknown option 'nope'"),
    ("city.json", {"options": {"iterations": "7"}},
     "city.json: option 'iterations' expects auto or a whole number"),
    ("city.json", {"options": {"batch": 0}},
     "city.json: option 'batch' expects a whole number of at least 1"),
    ("city.json", {"scene": 3}, "scene is '3'"),
    ("city.json", {"scene": None}, "scene is 'None'"),
    ("city.json", {"scene": "/no/such", "scene_absolute": "/no/such"}, "--scene"),
    ("city.json", {"scene": "a\x00b", "scene_absolute": "a\x00b"}, "--scene"),
    ("city.json", {"scene": "/no/such", "scene_absolute": 7}, "--scene"),
    ("city.json", {"fingerprint": "f" * 64}, "has changed since"),
    ("partition.json", {"replaces": 3}, "replaces is '3'"),
    ("partition.json", {"replaces": {"partition": "x"}}, "replaces is"),
    ("partition.json", {"replaces": {"partition": 1, "blocks": []}}, "replaces is"),
    ("partition.json", {"dropped": {"99": "far"}}, "view 99 of 32"),
    ("partition.json", {"dropped": {"-1": "far"}}, "view -1 of 32"),
    ("partition.json", {"dropped": {"a": "far"}}, "damaged"),
    ("partition.json", {"dropped": ["far"]}, "damaged"),
    ("partition.json", {"views": [[0], [32]]}, "view 32 of 32"),
    ("partition.json", {"views": [[0], [-1]]}, "view -1 of 32"),
    ("partition.json", {"views": [["a"], [0]]}, "damaged"),
    ("partition.json", {"views": [["HUGE"], [0]]}, "damaged"),
    ("partition.json", {"views": 7}, "damaged"),
    ("partition.json", {"views": [[0]]}, "2 regions and 1 lists"),
    ("partition.json", {"regions": []}, "damaged"),
    ("partition.json", {"regions": None}, "damaged"),
    ("partition.json", {"regions": [{"low": ["HUGE"] * 3, "high": [1, 1, 1], "margin": 0}]},
     "damaged"),
    ("partition.json", {"regions": [{"low": [0] * 3, "high": [1] * 3, "margin": "HUGE"}]},
     "damaged"),
    ("partition.json", {"regions": ["a", "b"]}, "damaged"),
    ("partition.json", {"space": None}, "damaged"),
    ("partition.json", {"space": {"rotation": "HUGE", "origin": 0, "half": 0,
                                  "contracted": 0}}, "damaged"),
    ("partition.json", {"notes": 3}, "damaged"),
    ("blocks/000/block.json", {"number": "0"}, "number is '0'"),
    ("blocks/000/block.json", {"number": -1}, "says that it is block -1 of 2"),
    ("blocks/000/block.json", {"number": 1}, "two partitions are mixed"),
    ("blocks/000/block.json", {"options": []}, "options is '[]'"),
    ("blocks/000/block.json", {"city": "0" * 64}, "another city"),
    ("blocks/000/block.json", {"partition": "0" * 64}, "another partition"),
]


@pytest.mark.parametrize("name, changes, said", EDITS)
def test_a_hand_edited_file_is_refused_by_merge(city, capsys, name, changes, said):
    edited(city / name, **changes)
    error = refused(capsys, "merge", city)
    assert said in error and str(city) in error


PARTITION_EDITS = [
    ("coarse/options.json", {"decisions": None}, "decisions is 'None'"),
    ("coarse/options.json", {"decisions": [1]}, "decisions is '[1]'"),
    ("coarse/options.json", {"decisions": {}}, "decisions is '{}'"),
    ("coarse/options.json", {"decisions": {"exposure": 3, "sh_degree": 1}}, "'exposure' expects"),
    ("coarse/options.json", {"decisions": {"exposure": "on", "sh_degree": 7}},
     "'sh-degree' expects"),
    ("coarse/options.json", {"downscale": "x"}, "'downscale' expects"),
    ("coarse/options.json", {"downscale": 0.5}, "'downscale' expects"),
    ("partition.json", {"asked": [1]}, "asked is '[1]'"),
    ("partition.json", {"asked": {"method": "citygs"}}, "was cut with method citygs"),
    ("partition.json", {"asked": {"grid": "x"}}, "was cut with grid x"),
    ("blocks/000/block.json", {"own": None}, "block"),
    ("blocks/000/block.json", {"own": "many"}, "block"),
]
FLAGS = ("--method", "blockgs", "--grid", "2x1", "--least-views", "1")


@pytest.mark.parametrize("name, changes, said", PARTITION_EDITS)
def test_a_hand_edited_file_is_refused_by_partition(city, capsys, name, changes, said):
    edited(city / name, **changes)
    assert said in refused(capsys, "partition", city, *FLAGS)


@pytest.mark.parametrize("changes", [
    {"low": None}, {"low": [0, 0]}, {"low": ["HUGE"] * 3}, {"margin": "HUGE"}, {"margin": "wide"},
    {"space": 3}, {"space": {}}, {"windows": 3}, {"windows": {"view_000.jpg": 3}},
    {"high": [None, None, "x"]}])
def test_a_hand_edited_region_is_refused_by_its_block(city, capsys, changes):
    path = city / "blocks" / "000" / "region.json"
    names = list(json.loads(path.read_text())["windows"]) or [
        sorted(p.name for p in (path.parent / "images").iterdir())[0]]
    if isinstance(changes.get("windows"), dict):
        changes = {"windows": {names[0]: [0, 0, 10**6, 10**6]}}
    edited(path, **changes)
    shutil.rmtree(city / "blocks" / "000" / "run")
    assert "region.json: damaged" in refused(capsys, "block", path.parent, "-q")


@pytest.mark.slow
@pytest.mark.parametrize("text", ["", '{"event": "st'])
@pytest.mark.parametrize("name", ["coarse", "blocks/000/run"])
def test_metrics_cut_short_by_a_kill_do_not_matter(city, capsys, name, text):
    (city / name / "metrics.jsonl").write_text(text)
    assert command(capsys, "merge", city, "--fill")[0] == 0


def test_a_map_that_is_gone_is_drawn_again(city, capsys):
    (city / "partition.png").unlink()
    (city / "partition.geojson").unlink()
    assert command(capsys, "merge", city)[0] == 0
    assert (city / "partition.png").stat().st_size > 1000
    assert "map of the blocks" in (city / "report.html").read_text()


def replaced(path, by):
    """A folder or file made into something else; `by`: what."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    if by == "folder":
        path.mkdir()
    elif by == "file":
        path.write_text("")
    elif by == "dangling":
        path.symlink_to("/no/such/place")


@pytest.mark.parametrize("name", ["city.json", "partition.json", "coarse", "blocks", "blocks/000",
                                  "blocks/000/block.json", "blocks/000/run",
                                  "blocks/000/run/point_cloud.ply"])
@pytest.mark.parametrize("by", ["folder", "file", "dangling", "nothing"])
def test_something_else_in_its_place_is_one_line(city, capsys, name, by):
    replaced(city / name, by)
    if name == "city.json" and by in ("dangling", "nothing"):  # begun again from the coarse run
        assert stages.begin_from_coarse(CityFolder(city))[1].iterations == 20
        assert json.loads((city / name).read_text())["options"]["downscale"] == 8
        return
    code, error = command(capsys, "merge", city)
    assert code == 2 and error.count("\n") == 1 and error.startswith("error: "), error


@pytest.mark.slow
@pytest.mark.parametrize("name", ["point_cloud.ply", "options.json", "report.html",
                                  "metrics.jsonl", "lod", "partition.png"])
def test_a_folder_or_link_where_merge_writes_is_one_line_or_replaced(city, capsys, name):
    replaced(city / name, "folder" if name != "lod" else "file")
    code, error = command(capsys, "merge", city)
    assert code == 2 and error.count("\n") == 1 and name in error, error
    replaced(city / name, "dangling")
    code, error = command(capsys, "merge", city)
    assert (code, error.count("\n")) in ((0, 0), (2, 1)), error


def test_a_renamed_and_a_doubled_block_are_told(city, capsys):
    shutil.copytree(city / "blocks" / "000", city / "blocks" / "007", symlinks=True)
    assert "two partitions are mixed here" in refused(capsys, "merge", city)
    shutil.rmtree(city / "blocks" / "000")
    assert "two partitions are mixed here" in refused(capsys, "merge", city)


@pytest.mark.slow
def test_folders_that_are_no_blocks_do_not_matter(city, capsys):
    for name in ("abc", "000.old", "-1", "٣"):
        (city / "blocks" / name).mkdir()
    assert command(capsys, "merge", city)[0] == 0


def test_a_block_linked_from_another_city_is_refused(city, capsys, tmp_path):
    """Its own city, which the link leads to, would take it."""
    other = tmp_path / "other"
    shutil.copytree(city, other, symlinks=True)
    edited(city / "partition.json", notes=["cut again"])
    for number in ("000", "001"):
        shutil.rmtree(city / "blocks" / number)
        (city / "blocks" / number).symlink_to(other / "blocks" / number)
    assert "another partition" in refused(capsys, "merge", city)


@pytest.mark.slow
def test_a_block_that_was_moved_and_linked_back_is_merged(city, capsys, tmp_path):
    (city / "blocks" / "000").rename(tmp_path / "elsewhere")
    (city / "blocks" / "000").symlink_to(tmp_path / "elsewhere")
    assert command(capsys, "merge", city)[0] == 0


def test_two_partitions_mixed_are_refused(city, capsys, made, tmp_path):
    """Block 001 of the same city cut another way."""
    other, scene = CityFolder(tmp_path / "other"), read_scene(CITY)
    options = resolve({}, json.loads((city / "city.json").read_text())["options"])
    stages.begin(other, scene, options)
    shutil.copytree(city / "coarse", other.coarse)
    cut.cut_into_blocks(other, scene, options,
                        PartitionOptions("vastgs", (2, 1), least_views=1), None)
    shutil.copytree(city / "blocks" / "001" / "run", other.block(1).run)
    shutil.rmtree(city / "blocks" / "001")
    shutil.copytree(other.block(1).path, city / "blocks" / "001", symlinks=True)
    assert "a block of another partition" in refused(capsys, "merge", city)
    assert "a block of another partition" in refused(capsys, "merge", city, "--fill")


# --- what a city may not take over


def test_a_finished_run_is_not_taken_over(made, tmp_path, capsys):
    """C2: neither by its options nor by its model, and nothing is written."""
    for name in ("options.json", "point_cloud.ply", "checkpoint.npz", "metrics.jsonl",
                 "block.json"):
        folder = tmp_path / name.replace(".", "_")
        folder.mkdir()
        (folder / name).write_text("x")
        error = refused(capsys, "city", CITY, "-o", folder, "-r", "8", "-n", "10", "-q")
        assert f"holds {name}, but no city" in error
        assert [path.name for path in folder.iterdir()] == [name]


def test_a_coarse_run_of_another_scene_is_not_taken_over(city, capsys):
    (city / "city.json").unlink()
    edited(city / "coarse" / "options.json", fingerprint="0" * 64)
    for name in ("partition.json", "partition.png", "partition.geojson"):
        (city / name).unlink()
    assert "is a run of another scene" in refused(
        capsys, "city", CITY, "-o", city, "-n", "20", "-r", "8", "--sh-degree", "1",
        "--exposure", "off", "-q")


def test_a_train_does_not_begin_in_a_city(city, capsys):
    for flag in ((), ("--overwrite",)):
        assert "holds a city" in refused(capsys, "train", CITY, "-o", city, "-n", "2", *flag)


@pytest.mark.parametrize("limit, small", [(0, 0), (1600, 800), (801, 401), (1, 1)])
def test_the_coarse_run_has_photos_half_as_large_as_the_blocks(limit, small):
    options = resolve({}, {"max_resolution": limit, "downscale": 3.0})
    coarse = stages.coarse_options(options, read_scene(CITY))
    assert (coarse.max_resolution, coarse.downscale) == (small, 6.0)
    view = read_scene(CITY).views[0].camera
    if limit != 1:
        whole, half = (view.reduced(o.downscale, o.max_resolution) for o in (options, coarse))
        assert abs(whole.width - 2 * half.width) <= 1


def test_the_coarse_run_takes_half_of_the_steps_that_photos_allow():
    """And a quarter before a joint training."""
    scene = read_scene(CITY)
    for visits, steps in ((1.0, 14), (50.0, 700), (0.0, 4500)):  # of 28 training photos
        options = resolve({}, {"visits": visits, "iterations": 9000})
        assert stages.coarse_options(options, scene).iterations == steps
        assert stages.coarse_options(options, scene, joint=True).iterations == steps // 2


def test_a_city_from_its_coarse_run_alone_has_twice_its_resolution(city, capsys):
    (city / "city.json").unlink()
    edited(city / "coarse" / "options.json", max_resolution=100)
    _, options = stages.begin_from_coarse(CityFolder(city))
    assert (options.max_resolution, options.downscale, options.iterations) == (200, 8.0, 20)


@pytest.mark.parametrize("folder", ["", ".", "empty"])
@pytest.mark.parametrize("name", ["merge", "partition"])
def test_no_city_is_one_line_and_nothing_is_made(tmp_path, capsys, monkeypatch, name, folder):
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    error = refused(capsys, name, folder)
    assert "holds no city" in error or "is empty" in error
    assert [path.name for path in tmp_path.rglob("*")] == ["empty"]


def test_offsets_of_the_made_city_are_whole(made):
    """The fixture itself: two blocks that own every gaussian once."""
    folder = CityFolder(made)
    assert len(folder.blocks()) == 2
    assert np.isfinite(RunFolder(folder.coarse).load_model().positions).all()


def test_a_city_whose_scene_was_moved_finds_its_photos_again(made, tmp_path, capsys):
    city = shutil.copytree(made, tmp_path / "city", symlinks=True)
    for folder in ("000", "001"):
        for link in (city / "blocks" / folder / "images").iterdir():
            link.unlink()
            link.symlink_to(tmp_path / "gone" / link.name)
    edited(city / "city.json", scene="../gone", scene_absolute=str(tmp_path / "gone"))
    assert "--scene" in refused(capsys, "partition", city, *FLAGS)
    folder = CityFolder(city)
    scene, options = stages.begin_from_coarse(folder, CITY)
    cut.cut_into_blocks(folder, scene, options, None, None)
    for block in folder.blocks():
        assert all(view.source.is_file() for view in read_scene(block.path).views)


def test_options_with_which_nothing_could_be_made_may_be_changed(made, tmp_path):
    """As those that the coarse run refuses."""
    folder, scene = CityFolder(tmp_path / "new"), read_scene(CITY)
    stages.begin(folder, scene, resolve({}, {"test_every": 1}))
    stages.begin(folder, scene, resolve({}, {"test_every": 8}))
    shutil.copytree(made / "coarse", folder.coarse)
    with pytest.raises(InputError, match="was begun with test_every 8; give the same options"):
        stages.begin(folder, scene, resolve({}, {"test_every": 1}))
