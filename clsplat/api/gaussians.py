"""`clsplat.Gaussians`: gaussians that are read, written and shown in notebooks."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from clsplat import gaussians
from clsplat.io.models.formats import read_model, write_model
from clsplat.report.notebook import model_frame


class Gaussians(gaussians.Gaussians):
    __doc__ = gaussians.Gaussians.__doc__

    @classmethod
    def of(cls, model: gaussians.Gaussians) -> Gaussians:
        """The same gaussians as an object of this class.

        Parameters
        ----------
        model : whose arrays are shared, not copied.
        """
        return model if isinstance(model, cls) else cls(model.rows, model.sh_degree, model.offset)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Gaussians:
        """Read a model.

        Parameters
        ----------
        path : a file of gaussians, by its suffix .ply, .sog, .spz or .glb, or of points, .ply, .las
            or .laz, which become the gaussians that a training starts from.

        Raises
        ------
        clsplat.ClsplatError : if it is not such a file, or is damaged.
        """
        return cls.of(read_model(Path(path)))

    def save(self, path: str | PathLike[str]) -> None:
        """Write a file in original coordinates.

        Parameters
        ----------
        path : the file, which is replaced as a whole; its suffix selects the format: .ply keeps
            every number, .glb keeps single precision, .sog and .spz are smaller,
            .las and .laz hold the centres as points.

        Raises
        ------
        clsplat.ClsplatError : if it cannot be written, or its suffix is another one.
        """
        write_model(Path(path), self)

    def _repr_html_(self) -> str:
        return model_frame(self)
