"""The photos and the poster of a page, as `clsplat export` embeds them."""

import json
import re

import pytest

from clsplat.apps import page_pictures
from clsplat.apps.page_pictures import photos_of_page
from tests.apps.test_models import run_with
from tests.estimate.test_plan import city, clsplat_
from tests.report.test_model_page import colourful

__all__ = ["city"]


def test_pictures_of_photos_have_a_bound(city, monkeypatch):
    whole = photos_of_page(city, True)
    assert [photo.name for photo in whole] == [view.name for view in city.views]
    assert all(photo.picture[:2] == b"\xff\xd8" for photo in whole)
    assert not any(photo.picture for photo in photos_of_page(city, False))
    for most in (40_000, 3000):
        monkeypatch.setattr(page_pictures, "MOST_BYTES", most)
        total = sum(len(photo.picture) for photo in photos_of_page(city, True))
        assert 0 < total <= most


def test_export_has_a_title_a_poster_and_photos(tmp_path, city, trained):
    """And on request no photos; other formats refuse what is for pages."""
    output = tmp_path / "page.html"
    result = clsplat_("export", trained, "-o", output, "--title", "A <yard>")
    assert result.exit_code == 0, result.output
    text = output.read_text("utf-8")
    assert "<title>A &lt;yard&gt;</title>" in text
    assert re.search(r'id="poster" alt="" src="data:image/jpeg;base64,\S{2000,}" data-ratio=', text)
    assert text.index('id="poster"') < text.index('id="cell0"') < text.index('id="photo_record"')
    record = json.loads(re.search(r'id="photo_record" type="application/json">(.*)</script>', text)[1])
    assert len(record) == len(city.views) and all(each["picture"] for each in record)
    result = clsplat_("export", trained, "-o", output, "--overwrite", "--no-photos")
    assert result.exit_code == 0 and '"picture": "data' not in output.read_text("utf-8")
    for words in (("--title", "x"), ("--no-photos",)):
        result = clsplat_("export", trained, "-o", tmp_path / "model.ply", *words)
        assert result.exit_code == 2 and f"{words[0]}: is for pages" in result.output


@pytest.fixture(scope="module")
def trained(tmp_path_factory, city):
    model = colourful(city, 300, 0)
    run = run_with(tmp_path_factory.mktemp("runs") / "run", model)
    run.save_model(model, city.offset)
    return run.path
