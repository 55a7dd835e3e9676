"""Options that decide how a scene is read."""

from dataclasses import dataclass

from clsplat.config.option import AUTO, option


@dataclass(frozen=True)
class SceneOptions:
    """Which photos are used, at which size, and the initial gaussians."""

    downscale: float = option(1.0, "Scene", "divide the width and height of the photos by this",
                              short="-r", main=True, minimum=1.0)
    max_resolution: int = option(1600, "Scene", "reduce photos whose longer side has more pixels "
                                 "than this", main=True, words={"none": 0}, minimum=1)
    images: str = option("", "Scene", "folder of the photos, relative to SCENE, such as images_4; "
                         "auto: images, else the largest folder images_N", main=True,
                         words={"auto": ""})
    test_every: int = option(8, "Scene", "hold out every N-th view, in the order of names, for "
                             "evaluation", main=True, words={"none": 0}, minimum=1)
    test_offset: int = option(0, "Scene", "with --test-every N: views before the first one that is "
                              "held out, less than N; other offsets hold out other views",
                              minimum=0)
    init: str = option(AUTO, "Scene", "initial gaussians: sfm (the sparse points), dense (places "
                       "on which several photos agree), random, or a file of gaussians or points; "
                       "auto: dense with --schedule sig, where photos overlap and the run is not "
                       "short, else sfm", main=True, measured=True)
