"""`clsplat.Scene` and `clsplat.View`: scenes that are read and shown in notebooks."""

from __future__ import annotations

from dataclasses import fields
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat import scene
from clsplat.io.photos.views import read_photo, read_valid
from clsplat.io.scenes.read import read_scene
from clsplat.report.notebook import scene_page, view_card


class View(scene.View):
    __doc__ = scene.View.__doc__

    def photo(self) -> NDArray[np.uint8]:
        """Read the photo.

        Returns
        -------
        uint8[H, W, 3], resampled to the camera's size.

        Raises
        ------
        clsplat.ClsplatError : if it does not exist, or is not an image that can be read.
        """
        return read_photo(self)

    def valid(self) -> NDArray[np.bool_] | None:
        """Read which pixels of the photo count, from its mask, its alpha and its lens.

        Returns
        -------
        bool[H, W] at the camera's size; None: all.

        Raises
        ------
        clsplat.ClsplatError : if the mask is not an image that can be read, or does not fit.
        """
        return read_valid(self)

    def _repr_html_(self) -> str:
        return view_card(self)


class Scene(scene.Scene):
    __doc__ = scene.Scene.__doc__
    views: tuple[View, ...]

    @classmethod
    def of(cls, data: scene.Scene) -> Scene:
        """The same scene as an object of this class.

        Parameters
        ----------
        data : whose arrays are shared, not copied.
        """
        if isinstance(data, cls):
            return data
        named = {each.name: getattr(data, each.name) for each in fields(data)}
        return cls(**{**named, "views": tuple(View(**vars(view)) for view in data.views)})

    @classmethod
    def read(cls, path: str | PathLike[str], images: str = "") -> Scene:
        """Read a scene.

        Parameters
        ----------
        path : a folder with a COLMAP model, transforms.json, the layout of CityGaussian or the
            project of another program, such as Metashape; or the file of such a project.
        images : the folder of its photos, relative to the scene's folder; "": images.

        Raises
        ------
        clsplat.ClsplatError : if it is not a scene, or is damaged; one line with the cure.
        """
        return cls.of(read_scene(Path(path).absolute(), images))  # the current folder may change

    if TYPE_CHECKING:  # views stay what they are

        def split(self, test_every: int, test_offset: int = 0) -> tuple[tuple[View, ...], tuple[View, ...]]: ...

    def _repr_html_(self) -> str:
        return scene_page(self)
