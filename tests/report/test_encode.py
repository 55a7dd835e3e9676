"""The parts of a large model on a page: a coarse model, and cells that replace it."""

import pytest

from clsplat.report import encode
from clsplat.report.encode import encoded
from tests.apps.browser import needs_chromium
from tests.estimate.test_plan import city
from tests.report.test_model_page import colourful, written
from tests.report.test_page_tools import found_in

__all__ = ["city"]


def test_a_large_model_is_a_coarse_one_and_cells(city, monkeypatch):
    monkeypatch.setattr(encode, "WHOLE", 1000)
    monkeypatch.setattr(encode, "CELL", 300)
    model = colourful(city, 2000, 1)
    told = []
    parts, coding = encoded(model, lambda *step: told.append(step))
    assert list(parts) == ["coarse", *(f"cell{number}" for number in range(8))]
    counts = [cell["count"] for cell in coding["cells"]]
    assert sum(counts) == coding["count"] == 2000 and max(counts) - min(counts) <= 1
    assert sum(cell["coarse"] for cell in coding["cells"]) == pytest.approx(250, abs=8)
    assert told[-1] == ("cell", 8, 8)


@pytest.mark.slow
@needs_chromium
@pytest.mark.parametrize("memory", [4, 32], ids=["phone", "desktop"])
@pytest.mark.one_in(2)
def test_cells_follow_a_coarse_picture(tmp_path, city, monkeypatch, memory):
    """All of them, or where there is little memory the nearest ones, in place of others."""
    monkeypatch.setattr(encode, "WHOLE", 1000)
    monkeypatch.setattr(encode, "CELL", 600)
    text = written(tmp_path / "page.html", city, colourful(city, 4000, 1))
    text = text.replace(
        "<head>", f"<head><script>Object.defineProperty(navigator, 'deviceMemory', {{ value: {memory} }});</script>", 1
    )
    text = text.replace("HELD_BY_A_PHONE = 1e6", "HELD_BY_A_PHONE = 2 * 4096")
    found = found_in(
        tmp_path,
        text,
        """
      const held = () => view.cells.slots.map(({ number }) => number);
      found.held = held();
      found.drawn = view.cells.ranges().reduce((sum, [, , count]) => sum + count, 0);
      found.ranges = view.cells.ranges().length;
      found.facts = $("facts").textContent;
      found.poster = $("poster") === null;
      const away = (cell) => Math.hypot(...cell.centre.map((x, k) => x - camera.position[k]));
      const nearest = () => [...view.cells.cells].sort((a, b) => away(a) - away(b)).slice(
        0, found.held.length).map(({ number }) => number).sort().join();
      const furthest = [...view.cells.cells].sort((a, b) => away(b) - away(a))[0];
      found.first = [...held()].sort().join() === nearest();
      camera.position = [...furthest.centre]; view.moved();
      await until(() => [...held()].sort().join() === nearest());
      found.follows = held().includes(furthest.number);
      view.hasty = true;
      found.hasty = view.cells.ranges(true).every(([first]) => first === 0);
    """,
    )
    assert all(found[name] for name in ("first", "follows", "hasty", "poster"))
    assert found["ranges"] == 8
    assert len(found["held"]) == (8 if memory == 32 else 2)
    assert found["drawn"] == (4000 if memory == 32 else 1000 + 6 * 62)
    assert ("near the camera" in found["facts"]) == (memory == 4)
