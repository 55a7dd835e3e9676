"""A made-up survey as photos and COLMAP leave it: a reconstruction in COLMAP's own axes and unit,
and the true map coordinates of its cameras and points."""

from dataclasses import replace

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from clsplat.io.photos.metadata import PhotoMetadata
from clsplat.io.scenes.colmap_files import write_colmap
from tests.data.fields import field

ORIGIN = np.array([587671.0, 3338100.0, 309.0])  # in UTM zone 14 north
CRS, SCALE = "EPSG:32614", 3.0  # metres in a unit of the field


class Survey:
    """The scene `field` after COLMAP has turned, scaled and moved it.

    Attributes
    ----------
    folder : with sparse/0.
    names : of the photos.
    centres, points : float64[N, 3], map coordinates of the cameras and the points.
    """

    def __init__(self, folder, cameras=12):
        scene = field(points=200, cameras=cameras)
        self.folder, self.names = folder, [f"{view.name}.jpg" for view in scene.views]
        turn, factor = Rotation.random(random_state=4).as_matrix(), 0.3
        views = []
        for view, name in zip(scene.views, self.names):
            camera = view.camera
            rotation = camera.rotation @ turn.T
            views.append(
                replace(
                    view, name=name, camera=replace(camera, rotation=rotation, translation=factor * camera.translation)
                )
            )
        write_colmap(folder / "sparse" / "0", views, factor * scene.points @ turn.T, scene.colours, scene.observations)
        self.scene, self.points = scene, ORIGIN + SCALE * scene.points
        self.centres = ORIGIN + SCALE * np.array([v.camera.position for v in scene.views])

    def reconstruction(self):
        """A new pycolmap.Reconstruction."""
        return pycolmap.Reconstruction(self.folder / "sparse" / "0")

    def metadata(self, noise=0.0):
        """name -> PhotoMetadata with GPS, whose errors have this standard deviation, metres."""
        positions = self.centres + np.random.default_rng(0).normal(0, noise, self.centres.shape)
        places = pycolmap.GPSTransform().utm_to_ellipsoid(positions, 14, True)
        return {
            name: PhotoMetadata(64, 48, latitude=place[0], longitude=place[1], altitude=height)
            for name, place, height in zip(self.names, places, positions[:, 2])
        }

    def marks(self, point):
        """(photo, x, y) where a point by its index appears in photos."""
        for name, view in zip(self.names, self.scene.views):
            if view.sees(self.scene.points[[point]])[0]:
                pixel = view.camera.project(self.scene.points[[point]])[0][0]
                yield name, *pixel.tolist()
