"""What positions of photos as priors do to the shape of a survey: the bowl of long strips.

    python -m tools.studies.priors [--strips 3] [--photos 60] [--seeds 4] [--keep photos]

A survey is made up whose true poses, lens and check points are known. The lens has what the camera
model that is fitted to it lacks (a principal point beside the middle, and distortion of higher
order), as real lenses do, so that photos alone bend long strips. The reconstruction is what a
bundle adjustment of the observations alone ends in. It is placed by `place_reconstruction` by a
similarity, and then with the positions as priors. Check points take no part in either.
"""

import argparse
import shlex
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from clsplat.io.georeference.control_points import ControlPoints
from clsplat.io.georeference.reconstruction import place_reconstruction
from clsplat.io.photos.metadata import PhotoMetadata
from clsplat.report.page import Table
from tools.studies.study import keep, keeps, markdown, outermost

ORIGIN = np.array([587600.0, 3338000.0, 300.0])  # UTM zone 14 north
WIDTH, HEIGHT, FOCAL = 4000, 3000, 3600.0
# fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6 of COLMAP's FULL_OPENCV
LENS = (FOCAL, FOCAL, WIDTH / 2 + 14, HEIGHT / 2 - 9, -0.09, 0.05, 2e-4, -1e-4, -0.02, 0, 0, 0)
ABOVE, STEP, ASIDE = 100.0, 18.0, 42.0  # metres: the flight, between photos, between strips
RELIEF = 6.0  # metres, the height of hills
KEYPOINT_STD = 0.5  # pixels
SPACING = 7.0  # metres between points
TITLE = "Positions of photos as priors"
HEAD = (
    "positions",
    "placed by",
    "check points along the ground, RMS, m",
    "height, RMS, m",
    "worst check point, m",
    "ends of strips above the middle, m",
)
OUTLIERS, FAR = 0.03, 40.0  # share of the positions, and how far they are wrong, metres


@dataclass(frozen=True)
class Receiver:
    """How wrong positions are: standard deviations to the east, to the north and up, metres; the
    share of their variance that drifts slowly through the flight; whether photos state them, and
    have heights."""

    std: tuple[float, float, float]
    drifting: float = 0.0
    stated: bool = False
    has_height: bool = True


RECEIVERS = {
    "GPS, 2 m": Receiver((2.0, 2.0, 3.0)),
    "GPS, 2 m, most of it drift": Receiver((2.0, 2.0, 3.0), 0.8),
    "RTK, 2 cm, stated": Receiver((0.02, 0.02, 0.03), stated=True),
}


class Strips:
    """A made survey of parallel strips above hills.

    Attributes
    ----------
    centres : float64[V, 3], true map coordinates of the cameras.
    checks : float64[C, 3], those of the check points.
    marks : for each check point, arrays of the photos that show it and of its pixels there.
    """

    def __init__(self, strips=3, photos=60, seed=0):
        rng = np.random.default_rng(seed)
        along, across = STEP * np.arange(photos), ASIDE * np.arange(strips)
        self.centres = np.array(
            [(x, y, ABOVE) for number, y in enumerate(across) for x in (along if number % 2 == 0 else along[::-1])]
        )
        self.centres += rng.normal(0, (1.0, 1.0, 1.0), self.centres.shape)
        # each strip is flown in the opposite direction of its neighbours
        yaw = np.repeat(np.arange(strips) % 2 * np.pi, photos)
        yaw += rng.normal(0, 0.02, len(yaw))
        down = Rotation.from_euler("x", np.pi)
        tilt = Rotation.from_rotvec(rng.normal(0, 0.02, (len(self.centres), 3)))
        self.rotations = tilt * down * Rotation.from_euler("z", yaw[:, None])  # world to camera
        low, high = (-30.0, -25.0), (along[-1] + 30.0, across[-1] + 25.0)
        x, y = np.meshgrid(*(np.arange(first, last, SPACING) for first, last in zip(low, high)))
        points = np.column_stack([x.ravel(), y.ravel()])
        points += rng.uniform(-SPACING / 2, SPACING / 2, points.shape)
        self.points = np.column_stack([points, self._hills(points)])
        x, y = np.meshgrid(np.linspace(along[0], along[-1], 13), np.linspace(0, across[-1], 3))
        checks = np.column_stack([x.ravel(), y.ravel()])
        self.checks = np.column_stack([checks, self._hills(checks)])
        self.lens = pycolmap.Camera(model="FULL_OPENCV", width=WIDTH, height=HEIGHT, params=LENS)
        self.tracks = self._seen(self.points, rng)
        self.marks = self._seen(self.checks, rng)

    @staticmethod
    def _hills(places):
        x, y = places.T
        return RELIEF * (np.sin(x / 37) + np.cos(y / 23 + x / 91)) / 2

    def _seen(self, points, rng):
        """For each point, the indices of the photos that show it, and pixels [K, 2] with noise."""
        found = [([], []) for _ in points]
        for view, (centre, rotation) in enumerate(zip(self.centres, self.rotations)):
            local = rotation.apply(points - centre)
            pixels = self.lens.img_from_cam(local)
            inside = ((pixels >= 0) & (pixels < (WIDTH, HEIGHT))).all(axis=1) & (
                np.abs(local[:, :2] / local[:, 2:]).max(axis=1) < 0.6
            )
            noisy = pixels + rng.normal(0, KEYPOINT_STD, pixels.shape)
            for row in np.flatnonzero(inside):
                found[row][0].append(view)
                found[row][1].append(noisy[row])
        return found

    def reconstruction(self, centre=False):
        """What a bundle adjustment without any positions makes of the observations, in another
        frame: it begins with the true poses and points, a focal length that is wrong by 1 % and no
        distortion, and fits the principal point on request."""
        result = pycolmap.Reconstruction()
        camera = pycolmap.Camera.create_from_model_name(1, "OPENCV", 1.01 * FOCAL, WIDTH, HEIGHT)
        result.add_camera_with_trivial_rig(camera)
        tracks = [(point, views, pixels) for point, (views, pixels) in zip(self.points, self.tracks) if len(views) >= 3]
        keypoints = [[] for _ in self.centres]
        elements = []
        for _, views, pixels in tracks:
            elements.append([(view, len(keypoints[view])) for view in views])
            for view, pixel in zip(views, pixels):
                keypoints[view].append(pixel)
        for view, pixels in enumerate(keypoints):
            rotation = self.rotations[view]
            image = pycolmap.Image(name=self.name(view), keypoints=np.array(pixels), camera_id=1, image_id=view + 1)
            result.add_image_with_trivial_frame(
                image, pycolmap.Rigid3d(pycolmap.Rotation3d(rotation.as_quat()), -rotation.apply(self.centres[view]))
            )
        for (point, _, _), places in zip(tracks, elements):
            track = pycolmap.Track()
            for view, index in places:
                track.add_element(view + 1, index)
            result.add_point3D(point, track)
        options = pycolmap.BundleAdjustmentOptions()
        options.print_summary, options.refine_principal_point = False, centre
        pycolmap.bundle_adjustment(result, options)
        result.update_point_3d_errors()
        result.transform(
            pycolmap.Sim3d(
                0.02, pycolmap.Rotation3d(Rotation.from_rotvec((0.4, -0.3, 0.9)).as_quat()), np.array([1.0, 2.0, 3.0])
            )
        )
        return result

    @staticmethod
    def name(view):
        """Of a photo."""
        return f"{view:04d}.jpg"

    def metadata(self, receiver, seed=0, outliers=OUTLIERS):
        """name -> PhotoMetadata with the positions that a receiver measures."""
        rng = np.random.default_rng(seed + 100)
        count = len(self.centres)
        slow, state = np.empty((count, 3)), rng.normal(size=3)
        for row in range(count):
            slow[row] = state
            state = 0.97 * state + np.sqrt(1 - 0.97**2) * rng.normal(size=3)
        noise = (
            np.sqrt(1 - receiver.drifting) * rng.normal(size=(count, 3)) + np.sqrt(receiver.drifting) * slow
        ) * receiver.std
        wrong = rng.choice(count, round(outliers * count), replace=False)
        noise[wrong] += (
            FAR * Rotation.random(len(wrong), random_state=seed).apply((1, 0, 0)) * (1, 1, 0.5) if len(wrong) else 0
        )
        places = pycolmap.GPSTransform().utm_to_ellipsoid(ORIGIN + self.centres + noise, 14, True)
        known = PhotoMetadata(
            WIDTH, HEIGHT, gps_std=receiver.std if receiver.stated else None, gimbal_pitch=-90.0, gimbal_roll=0.0
        )
        return {
            self.name(view): replace(
                known, latitude=place[0], longitude=place[1], altitude=place[2] if receiver.has_height else None
            )
            for view, place in enumerate(places)
        }

    def errors(self, reconstruction, offset):
        """float64[C, 3], metres: the places of the check points by the cameras, less the true ones."""
        camera, result = reconstruction.cameras[1], []
        for place, (views, pixels) in zip(self.checks, self.marks):
            poses = [reconstruction.images[view + 1].cam_from_world() for view in views]
            options = pycolmap.EstimateTriangulationOptions()
            options.ransac.max_error, options.ransac.random_seed = 0.1, 0
            found = pycolmap.estimate_triangulation(pixels, poses, [camera] * len(poses), options)
            result.append(found["xyz"] + offset - ORIGIN - place)
        return np.array(result)

    def bowl(self, errors):
        """Metres: by how much the ends of the strips lie higher than the middle, by a parabola."""
        x = (self.checks[:, 0] - np.median(self.checks[:, 0])) / np.ptp(self.checks[:, 0]) * 2
        return float(np.polyfit(x, errors[:, 2], 2)[0])


def measured(survey, reconstruction, metadata, **options):
    """Errors of the check points, and what became of a reconstruction, which stays as it is."""
    copy = pycolmap.Reconstruction(reconstruction)
    placed = place_reconstruction(copy, metadata, ControlPoints(), **options)
    return survey.errors(copy, placed.georeference.offset), placed, copy


def figures(survey, errors):
    """Metres: RMS along the ground and in height, the worst check point, and the bowl."""
    along, height, whole = (np.linalg.norm(part, axis=1) for part in (errors[:, :2], errors[:, 2:], errors))
    return (np.sqrt((along**2).mean()), np.sqrt((height**2).mean()), whole.max(), survey.bowl(errors))


def table(survey, seeds):
    """Figures of each receiver without and with priors, means over seeds of the positions."""
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    rows = []
    free, centred = survey.reconstruction(), survey.reconstruction(centre=True)
    for name, receiver in RECEIVERS.items():
        known = [survey.metadata(receiver, seed) for seed in range(seeds)]
        for what, reconstruction, adjusts in (
            ("similarity", free, False),
            ("priors", free, True),
            ("similarity, principal point fitted by photos alone", centred, False),
        ):
            means = np.mean(
                [figures(survey, measured(survey, reconstruction, each, adjusts=adjusts)[0]) for each in known], 0
            )
            rows.append((name, what, *(f"{value:.3f}" for value in means)))
            print(*rows[-1], sep="  ", flush=True)
    return Table(
        TITLE,
        HEAD,
        rows,
        range(2, 6),
        (
            f"A made survey: {len(survey.centres)} photos in strips {ABOVE:.0f} m above the ground, "
            f"with {100 * OUTLIERS:.0f} % of the positions wrong by {FAR:.0f} m; means of {seeds} "
            f"draws of the positions, {len(survey.checks)} check points that take no part. Drift: 80 % "
            "of the variance changes slowly through the flight.",
        ),
    )


def main(argv):
    """Make the survey and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--strips", type=int, default=3)
    parser.add_argument("--photos", type=int, default=60, help="of a strip")
    parser.add_argument("--seeds", type=int, default=4)
    keeps(parser)
    options = parser.parse_args(argv)
    made = table(Strips(options.strips, options.photos), options.seeds)
    print(markdown(made))
    keep(options.keep, [made], f"python -m tools.studies.priors {shlex.join(argv)}".strip(), "two CPU cores")


if __name__ == "__main__":
    outermost(main)
