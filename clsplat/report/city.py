"""Tables of a city: the blocks of the merged model, and the seams between them."""

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

from clsplat.io.runs.city import PICTURE, CityFolder, StageTime
from clsplat.report.page import Table, embedded
from clsplat.report.scores import Record

SEAM_COLUMNS = (
    ("pixels", "pixels"),
    ("psnr", "PSNR"),
    ("elsewhere_psnr", "elsewhere"),
    ("seam_db", "seam dB"),
)  # figure of a border, and its title
SEAM_NOTE = (
    "seam: gain in PSNR (colour-corrected, mean of views) over the reference elsewhere, "
    "minus the gain beside the border."
)
LONGEST_PAUSE = 10.0  # seconds without any stage that are shown


def city_sections(folder: Path, records: Sequence[Record]) -> list[Table | str]:
    """The map of the blocks and the tables of a merged city, from its folder and metrics; nothing
    for other runs."""
    last = {record["event"]: record for record in records if record.get("event") in ("merge", "seams")}
    if "merge" not in last:
        return []
    picture = folder / PICTURE
    sections = [embedded(picture, "map of the blocks")] if picture.is_file() else []
    return [
        *sections,
        time_line(CityFolder(folder).stages()),
        share_table(last["merge"]),
        *([seam_table(last["seams"])] if last.get("seams", {}).get("borders") else []),
    ]


def time_line(stages: Sequence[StageTime]) -> str:
    """HTML of which stages each worker did, and when; "" without any."""
    rows, end, paused = dict[str, list[list[StageTime]]](), 0.0, 0.0
    for stage in sorted(stages, key=lambda stage: stage.began):
        paused += max(0.0, stage.began - end - LONGEST_PAUSE) if end else 0.0
        end = max(end, stage.began + stage.seconds)
        of_worker = rows.setdefault(stage.worker, [])
        stage = stage._replace(began=stage.began - paused)
        free = next((row for row in of_worker if sum(row[-1][2:]) <= stage.began), None)
        if free is None:
            of_worker.append(free := [])
        free.append(stage)
    if not rows:
        return ""
    first = min(row[0].began for of_worker in rows.values() for row in of_worker)
    total = max(1e-9, end - paused - first)

    def bar(stage: StageTime) -> str:
        text = escape(f"{stage.name}: {stage.seconds:,.1f} s")
        return (
            f'<i style="left: {100 * (stage.began - first) / total:.2f}%; '
            f'width: {100 * stage.seconds / total:.2f}%" title="{text}">{text}</i>'
        )

    lines = "".join(
        f"<tr><th>{escape(worker) if row is of_worker[0] else ''}</th><td>{''.join(map(bar, row))}</td></tr>\n"
        for worker, of_worker in sorted(rows.items())
        for row in of_worker
    )
    return (
        f"<h2>Stages</h2>\n<p>When each worker did what, in {total:,.0f} seconds. Pauses "
        "between commands are shortened.</p>\n"
        f"<div class=scroll><table class=stages>\n{lines}</table></div>\n"
    )


def share_table(record: dict[str, Any]) -> Table:
    """A row for each block, from the record of a merge."""
    steps = record.get("joint_steps")
    jointly = [f"the merged model was then trained as a whole for {steps:,} steps"] if steps else []
    names = ("state", "gaussians", "trained", "views", "points", "note")
    rows = [(f"{share['block']:03d}", *(str(share[name]) for name in names)) for share in record["blocks"]]
    return Table(
        "Blocks",
        ("block", *names),
        rows,
        range(2, 6),
        (*jointly, *(f"{name}: in no block: {reason}" for name, reason in record["dropped"].items())),
    )


def seam_table(seams: dict[str, Any]) -> Table:
    """A row for each border, from the result of `city.seams.find_seams`."""

    def cell(value: float | None) -> str:
        return "-" if value is None else str(value) if isinstance(value, int) else f"{value:.2f}"

    rows = [
        (" | ".join(f"{block:03d}" for block in record["blocks"]), *(cell(record[name]) for name, _ in SEAM_COLUMNS))
        for record in seams["borders"]
    ]
    rows.append(("all", "", "", "", cell(seams["seam_db"])))
    return Table("Seams", ("blocks", *(title for _, title in SEAM_COLUMNS)), rows, range(1, 5), (SEAM_NOTE,))
