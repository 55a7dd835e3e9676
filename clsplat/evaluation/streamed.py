"""The model of a run as a tree, of which only what a camera needs is in memory."""

from __future__ import annotations

from dataclasses import dataclass

from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.io.models.tree import TREE, Tree
from clsplat.rendering.tree import HOST_BYTES, TreeRenderer


@dataclass(frozen=True)
class Streaming:
    """How a tree is drawn.

    Attributes
    ----------
    bias : levels are as coarse as if everything were this many times as far away; 0: the finest.
    host_bytes : of host memory; see `TreeRenderer`.
    """

    bias: float = 1.0
    host_bytes: float = HOST_BYTES


def streaming_of(run: Run, lod: bool, bias: float, host_bytes: float) -> Streaming | None:
    """How the tree of a run is drawn; None: its model is.

    Parameters
    ----------
    run : the run.
    lod : whether levels of detail are wanted. Otherwise a tree is drawn where there is no model, at
        its finest level.
    bias, host_bytes : as in Streaming.
    """
    if lod or has_tree(run) and not run.folder.has_model:
        return Streaming(bias if lod else 0.0, host_bytes)
    return None


def has_tree(run: Run) -> bool:
    """Whether a run has a tree."""
    return (run.path / TREE).is_file()


def open_tree(run: Run, device: Device, near: float, streaming: Streaming
              ) -> tuple[TreeRenderer, Tree]:
    """The tree of a run, and what draws it.

    Parameters
    ----------
    run : the run.
    device : an open device.
    near : depth of the near plane, units of the model.
    streaming : how it is drawn.

    Raises
    ------
    InputError : the run has no tree, or it is damaged.
    """
    if not has_tree(run):
        raise InputError(f"{run.path / TREE}: no such file; a city has levels of detail to be "
                         "streamed after `clsplat merge CITY --tree`")
    tree, options = Tree(run.path / TREE), run.options
    return TreeRenderer(device, tree, near, options.antialiased, options.background,
                        bias=streaming.bias, host_bytes=streaming.host_bytes), tree
