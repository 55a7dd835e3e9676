"""Tables of a city: the blocks of the merged model, and the seams between them."""

from typing import Any

from clsplat.report.page import Table


def share_table(record: dict[str, Any]) -> Table:
    """A row for each block.

    Parameters
    ----------
    record : of a merge in the city's metrics, or `city.merge.Merged.record`.
    """
    steps = record.get("joint_steps")
    jointly = [f"the merged model was then trained as a whole for {steps:,} steps"] if steps else []
    names = ("state", "gaussians", "trained", "views", "points", "note")
    rows = [(f"{share['block']:03d}", *(str(share[name]) for name in names))
            for share in record["blocks"]]
    return Table("Blocks", ("block", *names), rows, range(2, 6), (
        *jointly,
        *(f"{name}: in no block: {reason}" for name, reason in record["dropped"].items())))


def seam_table(seams: dict[str, Any]) -> Table:
    """A row for each border, from the result of `city.seams.find_seams`."""
    def cell(value: float | None) -> str:
        return "-" if value is None else f"{value:.2f}"

    rows = [(" | ".join(f"{block:03d}" for block in record["blocks"]),
             cell(record["overlap_psnr"]), cell(record["density_jump"]), str(record["pixels"]),
             cell(record["psnr"]), cell(record["elsewhere_psnr"]), cell(record["seam_db"]))
            for record in seams["borders"]]
    rows.append(("all", "", "", "", "", "", cell(seams["seam_db"])))
    return Table("Seams", ("blocks", "overlap dB", "density jump", "pixels", "PSNR", "elsewhere",
                           "seam dB"), rows, (1, 2, 3, 4, 5, 6), (
        "overlap: one block against the other, uncropped, beside their border; density jump: ln of "
        "the gaussians on one side over those on the other, minus that of the reference; seam: "
        "gain in PSNR (colour-corrected, mean of views) over the reference elsewhere, minus the "
        "gain beside the border.",))
