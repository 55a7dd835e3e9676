"""The numbers that host and kernels share, each written once: `SHARED` becomes -D of every build
(clsplat/device/programs.py). What only kernels know stands in cl/, what only the host knows in its
module.
"""

import math
from types import MappingProxyType
from typing import Final

NO_ROW: Final = 2**32 - 1  # in place of a row's number: nothing follows this gradient

# columns of a splat's row (cl/include/splat.h)
SPLAT_MEAN: Final = 0  # pixels
SPLAT_OPACITY: Final = 2
SPLAT_CUTOFF: Final = 3  # 2 ln(opacity ALPHA_STEPS): the squared distance at which alpha is skipped
SPLAT_CONIC: Final = 4  # a, b, c: squared distance = a dx^2 + 2 b dx dy + c dy^2
SPLAT_EXTENT_Y: Final = 7  # half height of the ellipse at the cutoff, pixels
SPLAT_COLOUR: Final = 8
SPLAT_DEPTH: Final = 11
SPLAT_REALS: Final = 12
CAMERA_REALS: Final = 27  # of a packed camera (cl/include/camera.h)
TRANSFORM_REALS: Final = 12  # of a colour transform, 3 x 4
VIGNETTING_TERMS: Final = 3  # powers of the squared radius (clsplat/response.py)
VIGNETTING_REALS: Final = VIGNETTING_TERMS + 1  # and the scale of the radius
POSE_REALS: Final = 6  # of the correction of a pose (cl/pose.cl): 3 of a turn, 3 of a shift
GEOMETRY_REALS: Final = 12  # of what takes a pixel at a depth to another view (cl/reproject.cl)
SHAPE_SUMS: Final = 6  # of a pair in the blend adjoint, beside those of its channels
FREQUENCY_TERMS: Final = 11  # columns of cl/frequency.cl
FREQUENCY_SUMS: Final = FREQUENCY_TERMS + 1
BRICK_CELLS: Final = 32  # along a side of a brick of a volume (cl/signed_distance.cl)
BRICK_SIDE: Final = BRICK_CELLS + 1  # samples, of which neighbours share a layer
COARSEST_PIXEL: Final = 4  # voxels: of the largest pixel whose depth counts in a volume

SIFT_LEVELS: Final = 6  # images of an octave (cl/sift.cl)
SIFT_SCALES: Final = 3  # of them an octave apart
SIFT_SIGMA: Final = 1.6  # pixels of its octave, by which the first is blurred (Lowe 2004)
SIFT_PADDING: Final = 16  # columns beside a row, as many as the widest Gaussian needs
DESCRIPTOR_SIZE: Final = 128  # numbers
NO_ANGLE: Final = -10.0  # radians, of a keypoint without a second orientation
TWO_VIEW_REALS: Final = 11  # of where another photo may show a feature (cl/match.cl)

SH_C0: Final = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 sqrt(pi))
# blending (Kerbl et al. 2023); docs/evidence/numerics.md compares other values of the first two
ALPHA_STEPS: Final = 255  # alphas below 1 / ALPHA_STEPS are skipped
TRANSMITTANCE_MIN: Final = 1e-4  # a pixel ends before it would fall below this
ALPHA_MAX: Final = 0.99

# Adam; 1 - beta is written rather than beta, since in single precision the difference loses digits
ONE_MINUS_BETA1: Final = 0.1
ONE_MINUS_BETA2: Final = 0.001
LOG_BETA1: Final = math.log(1 - ONE_MINUS_BETA1)
LOG_BETA2: Final = math.log(1 - ONE_MINUS_BETA2)
ADAM_EPSILON: Final = 1e-15  # Kerbl et al. (2023)
SMALL_COLUMNS: Final = 14  # of a gaussian without the harmonics above the constant
CATCH_UP_EVERY: Final = 100  # steps after which dense Adam moves the rows that no view saw, too
LAZY_TERMS: Final = 8  # columns of the sums by which a row catches up (cl/adam.cl)
PAGE_ABSENT: Final = 1 << 31  # in place of the slot of a page that is not on the device
PAGE_ROWS: Final = 4096  # rows whose harmonics come to the device and leave it together
STEP_SPREAD: Final = 8  # work-items of the group form for a row that has a gradient
CATCH_UP_SPREAD: Final = 2  # and for a row that may have to catch up

# numbers of a frame that stay on the device (cl/include/counts.h)
COUNT_VISIBLE: Final = 0  # gaussians that the view sees
COUNT_PAIRS: Final = 1  # of tile and splat, in the band at hand
COUNT_BUCKETS: Final = 2  # of pairs, in the group form
COUNT_FAILED: Final = 3  # 1 from the first frame for which an array was too small, or LACKS_PAGE
LACKS_PAGE: Final = 2  # of a frame that wants a page of harmonics that is not there
COUNT_NEEDED_VISIBLE: Final = 4  # what that frame would have needed, or 0
COUNT_NEEDED_PAIRS: Final = 5
COUNT_MOST_VISIBLE: Final = 6  # the largest numbers of any frame
COUNT_MOST_PAIRS: Final = 7
COUNT_DONE: Final = 8  # units of work that were done (clsplat/training/units.py)
COUNT_SUM_VISIBLE: Final = 10  # sums over the frames, in two words each
COUNT_SUM_PAIRS: Final = 12
FRAME_COUNTS: Final = 14

# how kernels are cut
LANES: Final = 256  # of a sum, in whatever groups: the order of additions; no group is larger
PER_ITEM: Final = 8  # elements of a chunk that a work-item of the group form lists or sorts
PROJECT_GROUP: Final = 64  # gaussians whose harmonics a group loads together
EXPOSURE_BLOCK: Final = 2048  # pixels that a partial sum of the exposure's gradient covers
POSE_BLOCK: Final = 1024  # gaussians that a partial sum of the pose's gradient covers

SHARED: Final = MappingProxyType({name: value for name, value in list(globals().items()) if name.isupper()})
