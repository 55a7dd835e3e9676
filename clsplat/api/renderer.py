"""`clsplat.render` and `clsplat.Renderer`: images of gaussians, and gradients back to them."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.api import gaussians as api
from clsplat.api.device import opened_device
from clsplat.camera import Camera, numbers, shown
from clsplat.constants import COUNT_FAILED, NO_ROW
from clsplat.device import Device as OpenedDevice
from clsplat.errors import InputError
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.io.photos.images import encode_image
from clsplat.rendering import pipeline
from clsplat.rendering.blend import MOST_CHANNELS
from clsplat.rendering.slabs import ModelRenderer, SlabFrame, gaussian_limit, open_model
from clsplat.scene import NEAR_SHARE
from clsplat.training.capacity import FrameCapacity

IN_FLIGHT = 8  # frames that are enqueued before the first one is read


def render(
    model: Gaussians,
    camera: Camera | None = None,
    *,
    cameras: Iterable[Camera] | None = None,
    device: OpenedDevice | None = None,
    depth: bool = False,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    near: float | None = None,
    antialiased: bool = False,
) -> Any:
    """Render gaussians from a camera, or from several.

    A model that is larger than the device is rendered in slabs of depth.

    Parameters
    ----------
    model : the gaussians.
    camera : the view; the offset of its world may differ from the model's.
    cameras : views, in place of `camera`. The device goes from one to the next without waiting for
        the host.
    device : an open device; None: the best one that works.
    depth : whether to return depths as well.
    background : red, green and blue, 0 to 1.
    near : depth of the near plane, world units; None: 1/500 of the model's size.
    antialiased : whether opacities are scaled by the area that the low-pass filter adds to a splat
        (Yu et al. 2024).

    Returns
    -------
    float32[H, W, 3], linear in the gaussians' colours, mostly 0 to 1; with `depth` a pair of it and
    float32[H, W], the mean depth along the camera's axis in world units, 0 where there is no
    gaussian. With `cameras` a list of these.

    Raises
    ------
    clsplat.ClsplatError : if no device works, or the frame does not fit its memory.
    """
    background, near = _checked(model, background, near)
    if camera is not None and cameras is not None:
        raise InputError("render: give a camera or cameras, not both")
    moved = [_in_frame_of(model, each) for each in ([camera] if cameras is None else cameras)]
    opened, rows = open_model(opened_device(device), model, near, antialiased, background)
    frames = [_result(frame, depth) for frame in _frames(opened, rows, moved, model, depth)]
    return frames[0] if cameras is None else frames


def _frames(
    opened: ModelRenderer, rows: Any, cameras: list[Camera], model: Gaussians, depth: bool
) -> Iterator[pipeline.Frame | SlabFrame]:
    """The frames of cameras. Those after the first have the room that frames before them needed,
    so that nothing waits; if that is too little, a frame is rendered again."""

    def one(camera: Camera, **room: Any) -> Any:
        return opened.render(
            rows, opened.pack(camera), camera.width, camera.height, model.sh_degree, with_depth=depth, **room
        )

    if len(cameras) == 1 or not isinstance(opened, pipeline.Renderer):
        yield from map(one, cameras)
        return
    capacity = FrameCapacity(opened)
    for begin in range(0, len(cameras), IN_FLIGHT):
        sent = []
        for camera in cameras[begin : begin + IN_FLIGHT]:
            size = camera.width, camera.height
            if not capacity.is_known(*size, depth):
                capacity.grow(rows, opened.pack(camera), *size)
            sent.append(one(camera, room=capacity.room(model.count, *size, depth)))
        for camera, frame in zip(cameras[begin:], sent):
            if frame.counts.download()[COUNT_FAILED]:
                capacity.grow(rows, frame.camera, camera.width, camera.height)
                frame = one(camera)
            yield frame


def _result(frame: pipeline.Frame | SlabFrame, depth: bool) -> Any:
    """What `render` returns for a frame."""
    image = _image(frame.image)
    if not depth:
        return image
    opaque = 1 - frame.blended.transmittance.download()
    mean = frame.blended.depth.download() / np.maximum(opaque, 1e-6)
    return image, np.where(opaque > 1e-6, mean, 0).astype(np.float32)


@dataclass(eq=False)
class Frame:
    """The result of `Renderer.forward`.

    Attributes
    ----------
    image : float32[H, W, 3], or with features float32[H, W, C].
    depth : float32[H, W], sums of weight times depth, world units; None if it was not requested.
    transmittance : float32[H, W], 0 to 1, the share of the background that is visible.
    """

    image: NDArray[np.float32]
    depth: NDArray[np.float32] | None
    transmittance: NDArray[np.float32]
    _frame: Any = field(repr=False)
    _camera: Camera = field(repr=False)

    def __repr__(self) -> str:
        height, width = self.transmittance.shape
        return f"<clsplat.Frame {width} x {height}{'' if self.depth is None else ', with depth'}>"

    def _repr_png_(self) -> bytes:
        last = self.image.shape[2] - 1  # of features, the first three
        return encode_image(self.image[..., [0, min(1, last), min(2, last)]], "png", 100, "PNG")


class Renderer:
    """Renders gaussians that stay on the device, and computes gradients by their parameters.

    Parameters
    ----------
    model : the initial gaussians; they must fit the device's memory.
    device : an open device; None: the best one that works.
    background, near, antialiased : as for `clsplat.render`.

    Raises
    ------
    clsplat.ClsplatError : if the model does not fit the device.
    """

    def __init__(
        self,
        model: Gaussians,
        device: OpenedDevice | None = None,
        *,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        near: float | None = None,
        antialiased: bool = False,
    ) -> None:
        background, near = _checked(model, background, near)
        self.device = device = opened_device(device)
        limit = gaussian_limit(device, model.sh_degree)
        if model.count > limit:
            raise InputError(
                f"{model.count:,} gaussians: the device has memory for {limit:,}; "
                "use clsplat.render, which renders larger models in slabs"
            )
        self.model = model
        self._pipeline = pipeline.Renderer(device, model.sh_degree, near, antialiased, background)
        self._rows = {f.name: device.upload(model.rows[f.name]) for f in LEARNED}

    def update(self, **fields: Any) -> None:
        """Replace parameters of the gaussians.

        Parameters
        ----------
        fields : those of `Gaussians`, in the same coordinates as the model's: positions
            float[N, 3], log_scales float[N, 3], quaternions float[N, 4] (wxyz), opacity_logits
            float[N], sh_constant float[N, 3], sh_rest float[N, bands, 3]; numpy arrays, or objects
            with `__array__` or `__dlpack__`.

        Raises
        ------
        clsplat.ClsplatError : for an unknown field, or one of another shape.
        """
        for name, array in checked_fields(fields, self.model.count, self.model.sh_degree).items():
            self._rows[name].write(array)

    def download(self) -> api.Gaussians:
        """The current gaussians, in host memory."""
        rows = {name: array.download().astype(np.float32) for name, array in self._rows.items()}
        return api.Gaussians(rows, self.model.sh_degree, self.model.offset)

    def forward(self, camera: Camera, *, depth: bool = False, features: Any = None) -> Frame:
        """Render from a camera.

        Parameters
        ----------
        camera : the view.
        depth : whether the frame has depths.
        features : float[N, C], any numbers of the gaussians, which are blended in place of the
            colours over zeros; C is 1 to 16.

        Returns
        -------
        A Frame, for `backward`.
        """
        packed = self._pipeline.pack(_in_frame_of(self.model, camera))
        if features is not None:
            features = _as_numpy(features, "features")
            if features.shape not in [(self.model.count, c + 1) for c in range(MOST_CHANNELS)]:
                raise InputError(
                    f"features: has shape {features.shape}, not ({self.model.count}, 1 to {MOST_CHANNELS})"
                )
            features = self.device.upload(features)
        frame = self._pipeline.render(
            self._rows, packed, camera.width, camera.height, self.model.sh_degree, with_depth=depth, features=features
        )
        depths = frame.blended.depth.download().astype(np.float32) if depth else None
        return Frame(
            _image(frame.image), depths, frame.blended.transmittance.download().astype(np.float32), frame, camera
        )

    def backward(
        self,
        frame: Frame,
        grad_image: Any,
        grad_depth: Any = None,
        grad_transmittance: Any = None,
        *,
        pose: bool = False,
    ) -> dict[str, NDArray[np.float32]]:
        """Gradients of a loss by the gaussians, and by the pose of the camera (the adjoint of
        `forward`).

        Parameters
        ----------
        frame : of the last `forward`; parameters must not have changed since.
        grad_image : of the shape of the image, gradient of the loss by it.
        grad_depth : float[H, W], by `frame.depth`, for a frame with depth.
        grad_transmittance : float[H, W], by `frame.transmittance`, for a frame with depth.
        pose : whether the gradient by the pose is wanted.

        Returns
        -------
        Field name -> float32 of the field's shape; 0 for gaussians that the camera does not see, or
        whose gradient is not finite. With `pose` also "turn" and "shift", float32[3]: the gradient
        by the arguments of `Camera.moved` where these are 0. For a frame of features also
        "features", float32[N, C].

        Raises
        ------
        clsplat.ClsplatError : for gradients of another shape, or by depths that the frame lacks.
        """
        height, width, channels = frame.image.shape
        if frame.depth is None and not (grad_depth is None and grad_transmittance is None):
            raise InputError("gradients of depth or transmittance need a frame with depth: forward(camera, depth=True)")
        gradients = self._pipeline.adjoint(
            self._rows,
            frame._frame,
            self._gradient(grad_image, "grad_image", (height, width, channels)),
            self._gradient(grad_depth, "grad_depth", (height, width)),
            self._gradient(grad_transmittance, "grad_transmittance", (height, width)),
            with_pose=pose,
        )
        rows = gradients.rows.download()
        finite = rows != NO_ROW
        dense, found = {}, dict(gradients.fields)
        if gradients.features is not None:
            found["features"] = gradients.features
        for name, values in found.items():
            dense[name] = np.zeros((self.model.count, *values.shape[1:]), np.float32)
            dense[name][rows[finite]] = values.download()[finite]
        if pose:
            turn, away = np.split(gradients.by_pose(), 2)
            dense |= {"turn": turn.astype(np.float32), "shift": (frame._camera.rotation @ away).astype(np.float32)}
        return dense

    def _gradient(self, values: Any, name: str, shape: tuple[int, ...]) -> Any:
        """A gradient on the device; None: it is zero."""
        if values is None:
            return None
        array = _as_numpy(values, name, shape)
        if array.ndim == 3:
            array = array.transpose(2, 0, 1)
        return self.device.upload(np.ascontiguousarray(array, self.device.real))


def checked_fields(fields: dict[str, Any], count: int, sh_degree: int) -> dict[str, NDArray[np.float32]]:
    """New parameters of gaussians as arrays; InputError if one does not fit the model."""
    known = {field.name: (count, *field.row_shape(sh_degree)) for field in LEARNED}
    for name in fields:
        if name not in known:
            raise InputError(f"{name}: not a field of gaussians; these are {', '.join(known)}")
    return {name: _as_numpy(values, name, known[name]) for name, values in fields.items()}


def _checked(model: Gaussians, background: Any, near: float | None) -> tuple[tuple[float, float, float], float]:
    """The background and the depth of the near plane; InputError for what is no such thing."""
    if not isinstance(model, Gaussians):
        raise InputError(f"model {shown(model)}: not gaussians; give clsplat.Gaussians, such as Gaussians.load(path)")
    if near is not None and numbers("near", near, ()) <= 0:
        raise InputError(f"near {near}: expects a depth above 0, or None")
    red, green, blue = numbers("background", background, (3,)).tolist()
    if near is None:  # from the gaussians' median distance from their median position
        near, positions = NEAR_SHARE, model.rows["positions"].astype(np.float64)
        if model.count:
            away = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
            near *= float(np.median(away)) or 1.0
    return (red, green, blue), float(near)


def _in_frame_of(model: Gaussians, camera: Camera | None) -> Camera:
    """The camera in the model's local coordinates; InputError if it can draw nothing."""
    if not isinstance(camera, Camera):
        raise InputError(f"camera {shown(camera)}: not a camera; give clsplat.Camera, such as a view's")
    camera.check()
    return camera.shifted(model.offset - camera.offset)


def _image(array: Any) -> NDArray[np.float32]:
    return np.ascontiguousarray(array.download().transpose(1, 2, 0), np.float32)


def _as_numpy(values: Any, name: str, shape: tuple[int, ...] | None = None) -> NDArray[np.float32]:
    """A numpy array, of this shape if one is given, of an object with `__dlpack__` or `__array__`,
    or of nested numbers; InputError for anything else, such as complex numbers."""
    if not hasattr(values, "__array__") and hasattr(values, "__dlpack__"):
        values = np.from_dlpack(values)
    try:
        array = np.asarray(values)
    except ValueError:  # rows of different lengths
        array = np.array(None)
    if array.dtype.kind not in "biuf":
        raise InputError(f"{name}: expects real numbers, got {shown(values)}")
    if shape not in (None, array.shape):
        raise InputError(f"{name}: has shape {array.shape}, not {shape}")
    return array.astype(np.float32, copy=False)
