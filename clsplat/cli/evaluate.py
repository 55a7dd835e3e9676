"""`clsplat eval` and `compare`: the scores of a run, and runs side by side."""

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import click

from clsplat.cli.flags import PATH, FiniteRange, device_flag, moved_scene_flag

PERCEPTUAL = ("flip", "flip_cc", "lpips", "lpips_cc")  # which no training computes


@click.command("eval")
@click.argument("run", type=PATH)
@device_flag
@click.option(
    "--images/--no-images",
    default=True,
    show_default=True,
    help="Write each view's photo, renders and error side by side as PNG, and replace "
    "the pictures and scores in report.html.",
)
@click.option(
    "--lpips",
    type=PATH,
    metavar="FILE",
    help="ONNX file of an LPIPS network, by which to compare as well; needs `pip install onnxruntime`.",
)
@click.option(
    "--align",
    is_flag=True,
    help="Also compare from poses that are aligned with the photos on the finished "
    "model, by the same rule for every run.",
)
@moved_scene_flag
def evaluate(run: Path, device: str, images: bool, lpips: Path | None, align: bool, scene: Path | None) -> None:
    """Compare the held-out views of RUN with their photos.

    PSNR (dB), SSIM and FLIP (0 to 1, lower is better) are means over views, plain and after a
    quadratic fit of each render's colours to its photo. Where the run learned exposures, held-out
    views are rendered with one that follows from those of the training photos alone.

    The given poses of held-out views are not exact, and a sharp model suffers most from that. With
    --align each is moved a little against its photo, while the model stays as it is: this compares
    runs with and without --poses.
    """
    from clsplat.device import choose_device
    from clsplat.evaluation.pictures import LEGEND
    from clsplat.evaluation.run import Run
    from clsplat.evaluation.views import PANELS, evaluate_run, final_metrics

    opened = Run.open(run)
    folder = opened.folder
    folder.check_model()
    metrics = final_metrics(lpips)
    with folder.locked() if images else nullcontext():
        whole = opened.scene(scene, whole=True)
        result = evaluate_run(opened, choose_device(device), images, opened.as_trained(whole), metrics, align)
        click.echo(summary(result))
        if images:
            from clsplat.report.run import write_report

            if opened.is_finished:  # else its last evaluation was that of another model
                folder.add_scores(
                    {key: value for key, value in result.items() if key in PERCEPTUAL or "aligned" in key}
                )
            written = write_report(folder, result["pictures"], whole)
            click.echo(
                f"pictures: {folder.pictures}\n  from left to right: {', '.join(PANELS)} ({LEGEND})\nreport: {written}"
            )


def summary(result: dict[str, Any]) -> str:
    """The table of an evaluation, as text."""
    from clsplat.evaluation.held_out_responses import Predicted
    from clsplat.report.page import Table

    kinds, notes = {"plain": "", "colour-corrected": "_cc"}, []
    if "aligned_degrees" in result:
        kinds |= {"aligned": "_aligned", "both": "_cc_aligned"}
        notes = [
            f"moved by {result['aligned_degrees']:.3f} degrees and "
            f"{result['aligned_shift']:.3%} of the depth in the mean"
        ]
    if "exposure_weight" in result:
        notes.append(f"exposure of held-out views: {Predicted(weight=result['exposure_weight'])}")
    names = [name for name in ("psnr", "ssim", "flip", "lpips") if name in result]
    rows = [
        (label, *(f"{result[name + suffix]:.{2 if name == 'psnr' else 4}f}" for name in names))
        for label, suffix in kinds.items()
    ]
    views = f"{result['views']} held-out view{'s' if result['views'] != 1 else ''}"
    return Table(views, ("", *map(str.upper, names)), rows, range(1, 1 + len(names)), notes).text()


@click.command()
@click.argument("runs", nargs=-1, required=True, type=PATH)
@click.option(
    "-o", "--output", type=PATH, help="Folder for compare.html and compare.json; default: the common folder of RUNS."
)
@click.option(
    "--psnr",
    "levels",
    multiple=True,
    type=FiniteRange(min=0),
    help="Colour-corrected PSNR, dB, whose training times to list; repeatable; default: three chosen from the data.",
)
def compare(runs: tuple[Path, ...], output: Path | None, levels: tuple[float, ...]) -> None:
    """Plot the error of RUNS over training time.

    RUNS are run folders, or folders with several runs. Runs that differ only by seed are drawn as
    one, with their spread.
    """
    from clsplat.report.compare import write_comparison

    text, page = write_comparison(runs, output, levels)
    click.echo(f"{text}\n\npage: {click.format_filename(page)}")
