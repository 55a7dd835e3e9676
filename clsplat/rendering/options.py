"""Options of how gaussians become an image."""

from dataclasses import dataclass

from clsplat.config.option import AUTO, option


@dataclass(frozen=True)
class RenderingOptions:
    """How gaussians become an image."""

    sh_degree: int = option(
        3, "Rendering", "highest degree of the spherical harmonics", main=True, minimum=0, maximum=3, measured=True
    )
    sh_every: int = option(
        1000,
        "Rendering",
        "steps after which the next degree of the spherical harmonics begins to train",
        minimum=1,
        flag=False,
        measured=True,
    )
    antialiased: bool = option(
        False, "Rendering", "scale opacities by the area that the low-pass filter adds to a splat", measured=True
    )
    near: float = option(
        0.0,
        "Rendering",
        "distance of the near plane, world units; auto: 1/500 of the scene extent",
        words={AUTO: 0.0},
        minimum=0.0,
        flag=False,
    )
    background: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0),
        "Rendering",
        "background colour: red, green and blue from 0 to 1",
        minimum=0.0,
        maximum=1.0,
        expects="three numbers from 0 to 1",
        flag=False,
    )
