"""A term of the loss with a learned parameter, in a package of your own: differences of pixels as
draws from a distribution with heavy tails (Cauchy), whose width is learned beside the gaussians.

From Python, give it to a training: clsplat.train(SCENE, parts=[CauchyLoss(0.1)]). For the command
line, put this file into a package, add these lines to its setup.cfg, and install it. Then a file of
`--config` with add-parts = ["cauchy"] and cauchy-weight = 0.1 uses it:

    [options.entry_points]
    clsplat.parts =
        cauchy = learned_scale:CauchyLoss
"""

from dataclasses import dataclass

import numpy as np

from clsplat import Part, option

RATE = 0.01  # of the Adam steps of the width


@dataclass(frozen=True)
class CauchyOptions:
    """Options of this part; they become flags, keys of a TOML file and Python arguments."""

    cauchy_weight: float = option(0.1, "Loss", "weight of the Cauchy loss", minimum=0.0)


class CauchyLoss(Part):
    """Adds weight * mean(log(s) + log(1 + (difference / s)^2)), and learns log(s) by Adam.

    `Part` documents each hook. This part computes on the host, so it `waits`: its steps are slower
    than with a kernel.
    """

    name = "cauchy"
    Options = CauchyOptions
    waits = True

    def __init__(self, weight: float = 0.1) -> None:
        self.weight = weight
        self.learned = np.array([np.log(0.1), 0.0, 0.0, 0.0])  # log(s), its moments, their steps

    def begin(self, session):
        """Take the weight of the options, if a command gave them."""
        self.weight = getattr(session.options, "cauchy_weight", self.weight)

    def add_to(self, work, inputs):
        """Add the gradient by the image, and take a step on log(s)."""
        image, photo = work.frame.exposed, work.photo.download()[:3] / 255
        scale, difference = np.exp(self.learned[0]), image.download() - photo
        spread = scale**2 + difference**2
        gradient = self.weight * 2 * difference / spread / difference.size
        work.grad.add(image=image.device.upload(gradient))
        self.step(self.weight * float(np.mean(1 - 2 * difference**2 / spread)))
        return float(scale)

    def step(self, gradient: float) -> None:
        """One step of Adam."""
        log_scale, m, v, steps = self.learned
        m, v, steps = 0.9 * m + 0.1 * gradient, 0.999 * v + 0.001 * gradient**2, steps + 1
        mean, square = m / (1 - 0.9**steps), v / (1 - 0.999**steps)
        self.learned[:] = log_scale - RATE * mean / (np.sqrt(square) + 1e-15), m, v, steps

    def values(self, measured):
        """The width, for metrics.jsonl."""
        return {"cauchy_scale": float(np.mean(measured))}

    def state(self):
        """What a checkpoint keeps."""
        return {"learned": self.learned}

    def load(self, state, session):
        """Continue from a checkpoint."""
        self.learned[:] = state["learned"]
