"""`clsplat eval`: the held-out views of a run against their photos."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import click


@click.command("eval")
@click.argument("run", type=click.Path(path_type=Path))
@click.option("--device", default="auto", show_default=True,
              help="auto, cpu, gpu, a number of `clsplat devices`, or part of a name.")
@click.option("--images/--no-images", default=True, show_default=True,
              help="Write each view's photo, renders and error side by side as PNG, and replace "
              "the pictures in report.html.")
@click.option("--scene", type=click.Path(path_type=Path),
              help="Where the scene is now, if it was moved.")
def evaluate(run: Path, device: str, images: bool, scene: Path | None) -> None:
    """Compare the held-out views of RUN with their photos.

    PSNR (dB) and SSIM are means over views, plain and after a quadratic fit of each render's
    colours to its photo. For a synthetic city, floaters are the share of opacity that is more than
    1, 3 and 10 pixels away from the true surface.
    """
    from clsplat.device import choose_device
    from clsplat.evaluation.error_map import LEGEND
    from clsplat.evaluation.run import Run
    from clsplat.evaluation.views import PANELS, evaluate_run
    opened = Run.open(run)
    folder = opened.folder
    folder.check_model()
    with folder.locked() if images else nullcontext():
        result = evaluate_run(opened, choose_device(device), images, scene)
        click.echo(summary(result))
        if images:
            from clsplat.report.run import renew_pictures
            click.echo(f"pictures: {folder.renders.folder}\n"
                       f"  from left to right: {', '.join(PANELS)} ({LEGEND})\n"
                       f"report: {renew_pictures(folder, result['pictures'])}")


def summary(result: dict[str, Any]) -> str:
    """The table of an evaluation, as text."""
    views = f"{result['views']} held-out view{'s' if result['views'] != 1 else ''}"
    lines = [f"{views:<20}{'PSNR':>8}{'SSIM':>8}"]
    for label, suffix in (("plain", ""), ("colour-corrected", "_cc")):
        lines.append(f"{label:<20}{result['psnr' + suffix]:>8.2f}{result['ssim' + suffix]:>8.4f}")
    if "floaters" in result:
        lines.append(f"{'pixels off':<20}{'> 1':>8}{'> 3':>8}{'> 10':>8}")
        shares = (result[key] for key in ("floaters", "floaters_3", "floaters_10"))
        lines.append(f"{'floaters':<20}" + "".join(f"{share:>8.2%}" for share in shares))
    return "\n".join(lines)
