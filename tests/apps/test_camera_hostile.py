"""Cameras of films and pages over scenes of every kind: speed, turns, and where they look."""

import numpy as np
import pytest

from clsplat.apps.camera_path import auto, interpolated
from clsplat.apps.models import in_original, supported
from clsplat.camera import Camera
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.report.model_page import view_record
from clsplat.scene import Scene, View

UP = np.array([0, 0, 1.0])
RNG = np.random.default_rng(3)
FPS, SECONDS = 10, 20
MOST_TURN, SPEED_SPREAD = 8.0, 0.1  # degrees a second, share of the median


def ground(width, depth, count=400, centre=(0, 0, 0)):
    return RNG.uniform(-1, 1, (count, 3)) * (width / 2, depth / 2, 0.5) + centre


def nadir(width, depth, height=80.0, columns=6, rows=5):
    """The strips of a survey that look straight down, every second one flown backwards."""
    cameras = []
    for row, y in enumerate(np.linspace(-depth / 2, depth / 2, rows)):
        for x in np.linspace(-width / 2, width / 2, columns)[:: -1 if row % 2 else 1]:
            up = (-1 if row % 2 else 1, 0, 0)
            cameras.append(Camera.looking_at((x, y, 0), (x, y, height), up=up))
    return cameras


def ring(count=24, radius=10.0, height=3.0):
    return [
        Camera.looking_at((0, 0, 1), (radius * np.cos(a), radius * np.sin(a), height))
        for a in np.linspace(0, 2 * np.pi, count, endpoint=False)
    ]


def facade(count=15):
    return [Camera.looking_at((x, 0, 5), (x, -20, 5 + x % 3)) for x in np.linspace(-30, 30, count)]


def scene_of(cameras, points, **more):
    views = tuple(View(f"{i:04d}.jpg", camera, b"") for i, camera in enumerate(cameras))
    return Scene("made", views, points, np.zeros((len(points), 3), np.uint8), given_up=UP, **more)


CORRIDOR = [
    Camera.looking_at((x, 40 * np.sin(x / 400), 0), (x, 40 * np.sin(x / 400), 80), up=(1, 0, 0))
    for x in np.linspace(-600, 600, 40)
]
BENT = np.array([[x, 40 * np.sin(x / 400) + y, 0] for x in np.linspace(-640, 640, 200) for y in (-30, -10, 10, 30)])

SURVEYS = {
    "square": scene_of(nadir(130, 130), ground(150, 150)),
    "corridor": scene_of(CORRIDOR, BENT),
    "one strip": scene_of(nadir(400, 0, rows=1, columns=20), ground(420, 60)),
    "one place": scene_of(nadir(0, 0, rows=3, columns=3), ground(60, 60)),
    "large unit": scene_of(nadir(130, 130), ground(150, 150), unit=1e6),
    "stray points": scene_of(
        nadir(130, 130), np.concatenate([ground(150, 150), ground(1e5, 1e5, 8), ground(50, 50, 4, (0, 0, -900))])
    ),
    "three points": scene_of(nadir(130, 130), np.array([[-60, 0, 0], [0, 1, 0], [60, 0, 0.0]])),
    "all points in one place": scene_of(nadir(130, 130), np.zeros((9, 3))),
    "tilted by 40 degrees to every side": scene_of(
        [
            Camera.looking_at((x - 67 * dx, y - 67 * dy, 0), (x, y, 80))
            for x in (-60, 0, 60)
            for y in (-60, 0, 60)
            for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1))
        ],
        ground(250, 250),
    ),
}


def film_of(scene):
    return interpolated(auto(scene, SECONDS), np.linspace(0, 1, FPS * SECONDS), (1280, 720), 60.0)


@pytest.mark.parametrize("name", SURVEYS)
def test_a_film_over_a_survey_can_be_watched(name):
    """It is steady, oblique and upright."""
    cameras = film_of(SURVEYS[name])
    ways = np.linalg.norm(np.diff([camera.position for camera in cameras], axis=0), axis=1)
    turns = FPS * np.degrees(
        [np.arccos(np.clip((np.trace(b.rotation @ a.rotation.T) - 1) / 2, -1, 1)) for a, b in zip(cameras, cameras[1:])]
    )
    assert turns.max() <= MOST_TURN and turns.std() < 1 + turns.mean()
    assert abs(ways / np.median(ways) - 1).max() < SPEED_SPREAD
    slopes = np.array([camera.rotation[2] @ UP for camera in cameras])
    assert abs(np.degrees(np.arcsin(slopes)) + 45).max() < 1
    assert min(-camera.rotation[1] @ UP for camera in cameras) > 0.5


@pytest.mark.parametrize("name", ["square", "corridor", "one strip", "stray points"])
def test_the_middle_of_the_picture_is_ground_that_photos_show(name):
    scene = SURVEYS[name]
    for camera in film_of(scene)[::20]:
        ahead = camera.rotation[2]
        place = camera.position - ahead * camera.position[2] / ahead[2]
        shown = sum(view.sees(place[None])[0] for view in scene.views)
        assert shown >= 2, place


def model_at(positions):
    rows = {f.name: np.zeros((len(positions), *f.row_shape(0)), np.float32) for f in LEARNED}
    return Gaussians({**rows, "positions": np.asarray(positions, np.float32)}, 0)


@pytest.mark.parametrize(
    "positions, kept",
    [
        ([[0, 0, 0], [300, 0, 0], [0, 0, 500]], [True, False, False]),
        ([[300, 0, 0], [0, 300, 0]], [True, True]),  # none is supported: a film of nothing helps nobody
        ([[0, 0, 0], [np.nan, 0, 0], [1e30, 0, 0]], [True, False, False]),
    ],
)
@pytest.mark.parametrize("offset, unit", [((0, 0, 0), 1.0), ((5e5, 5.7e6, 300), 2.0)])
def test_what_fewer_than_two_photos_show_is_left_out(positions, kept, offset, unit, caplog):
    scene = scene_of(nadir(130, 130), ground(150, 150), offset=np.array(offset, float), unit=unit)
    model = model_at(unit * np.reshape(positions, (-1, 3)))
    model = Gaussians(model.rows, 0, np.array(offset, float))
    assert supported(model, in_original(scene)).tolist() == kept
    warned = [line.getMessage() for line in caplog.records]
    assert warned == ["no two photos show any of the 2 gaussians, so all are kept"] * (kept == [True, True])


@pytest.mark.parametrize(
    "cameras, first, low, high",
    [(nadir(130, 130), -50, -90, -30), (facade(), 0, -27, 20), (ring(), -11, -31, 9), ([], -50, -70, -30)],
    ids=["survey", "facade", "ring", "no scene"],
)
def test_the_reader_looks_where_photos_looked(cameras, first, low, high):
    angle = np.radians(first)
    camera = Camera.looking_at((0, 0, 0), -100 * np.array([np.cos(angle), 0, np.sin(angle)]))
    points = ground(100, 100)
    record = view_record(camera, UP, points, cameras)
    assert np.allclose(np.degrees(record["pitches"]), (low, high), atol=2.1)
    assert record["reach"] == 4 * record["distance"]
    assert np.allclose(record["middle"], camera.position + record["distance"] * camera.rotation[2])
    assert record["ground"] <= camera.position[2]


@pytest.mark.parametrize(
    "points",
    [np.zeros((0, 3)), np.full((2, 3), np.nan), np.zeros((1, 3)), np.float32([[3e38, 3e38, 3e38]])],
    ids=["none", "not finite", "one", "largest"],
)
def test_limits_are_finite_for_every_model(points):
    record = view_record(Camera.looking_at((0, 0, 0), (0, -10, 5)), UP, points)
    assert np.isfinite([record["reach"], *record["pitches"], *record["middle"], record["ground"]]).all()
