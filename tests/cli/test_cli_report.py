"""`clresample report`: what it writes, says and refuses."""

import pytest
from helpers.field_folder import write_folder

from clresample.cli import main


def test_a_page_is_written_beside_the_run_and_may_be_replaced(tmp_path, capsys):
    write_folder(tmp_path)
    for _ in range(2):
        assert main(["report", str(tmp_path)]) == 0
    told = capsys.readouterr()
    assert told.out.split() == [str(tmp_path / "report.html")] * 2 and told.err == ""
    assert (tmp_path / "report.html").read_text().startswith("<!DOCTYPE html>")
    assert sorted(tmp_path.glob(".*")) == []


def test_what_is_missing_is_noted(tmp_path, capsys):
    write_folder(tmp_path)
    (tmp_path / "model_Rubin.fits").unlink()
    assert main(["report", str(tmp_path), "-o", str(tmp_path / "page.html")]) == 0
    assert "note: no images of Rubin:" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{}/none"], "none: no such folder"),
        (["{}"], "holds no run of `clresample field`"),
        (["{}/run", "--truth", "{}/none.fits"], "none.fits: no such file"),
        (["{}/run", "--truth", "{}/run/fit_table.ecsv"], "is not the truth of a field"),
        (["{}/run", "--max-size", "1M"], "most_bytes is 1048576"),
        (["{}/run", "-o", "{}/run/catalogue.fits", "--overwrite"], "is one of the inputs"),
        (["{}/run", "-o", "{}/run/provenance.json"], "is one of the inputs"),
        (["{}/run", "-o", "{}/there.html"], "exists already"),
        (["{}/run", "-o", "{}"], "is a directory"),
    ],
)
def test_mistakes_are_told_in_one_line(tmp_path, capsys, arguments, message):
    write_folder(tmp_path / "run", n_sources=3, n_px=64)
    (tmp_path / "there.html").write_text("mine")
    assert main(["report", *(a.format(tmp_path) for a in arguments)]) == 2
    told = capsys.readouterr()
    assert told.err.startswith("clresample report: ") and told.err.count("\n") == 1
    assert message in told.err and told.out == ""
    assert (tmp_path / "there.html").read_text() == "mine"
    assert not (tmp_path / "run" / "report.html").exists()
