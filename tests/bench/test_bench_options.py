"""Bad options of the benchmarks: one line, which names them, and exit status 2."""

import importlib

import pytest
from helpers.benches import run_bench
from helpers.checkout import run_python

pytest.importorskip("galsim")

CASES = [
    ("contract", "--json .", "--json ."),
    ("contract", "--json nowhere/x.json", "nowhere"),
    ("contract", "--seconds nan", "nan"),
    ("coverage", "--scenes 0", "0 is not above 0"),
    ("coverage", "--modes hst", "hst"),
    ("coverage", "--catalogue nowhere", "nowhere"),
    ("deblend", "--scenes 0", "0 is not above 0"),
    ("deblend", "--seed -1", "-1 is below 0"),
    ("deblend", "--views upside-down", "upside-down"),
    ("deblend", "--max-iter few", "few"),
    ("deblend", "--catalogue nowhere", "nowhere"),
    ("deblend", "--json .", "--json ."),
    ("kills.__main__", "nothing", "nothing"),
    ("kills.__main__", "fields --only rain", "rain"),
    ("kills.__main__", "commands --times -1", "-1 is below 0"),
    ("ladder", "--only single,comet", "comet"),
    ("ladder", "--snr -3", "-3 is not above 0"),
    ("paper.accuracy", "--printed --wide", "leave --printed out"),
    ("paper.accuracy", "--galaxies 0", "0 is not above 0"),
    ("paper.accuracy", "--processes none", "none"),
    ("paper.joint", "--scenes none", "none"),
    ("paper.joint", "--catalogue nowhere --folder .", "nowhere"),
    ("paper.report", "--folder docs", "no results"),
    ("paper.timing", "--pairs RUBIN-HST", "RUBIN-HST is not FROM-TO"),
    ("paper.timing", "--sizes 1 --pairs EUCLID-RUBIN", "no observed pixel"),
    ("paper.timing", "--folder Makefile", "--folder Makefile"),
    ("real", "--galaxies many", "many"),
    ("real", "--json .", "--json ."),
    ("render", "--sizes 0", "0 is not above 0"),
    ("render", "--sizes 1 --pairs EUCLID-RUBIN", "no observed pixel"),
    ("render", "--quick --sizes 20", "leave --sizes out"),
    ("render", "--pairs RUBIN-HST", "RUBIN-HST is not FROM-TO"),
    ("render", "--galaxies few", "few"),
    ("render", "--catalogue nowhere", "nowhere"),
    ("render", "--fast", "--fast"),
    ("settings", "--settings best", "best"),
    ("spoilt", "--only rain", "rain"),
    ("spoilt", "--scenes m87", "m87"),
    ("stages", "--seed few", "few"),
    ("throughput", "--blends 7", "7"),
    ("throughput", "--limit -1", "-1 is not above 0"),
]


@pytest.mark.parametrize(("module", "options", "words"), CASES)
def test_bad_options_get_one_line(module, options, words, capsys):
    with pytest.raises(SystemExit) as ended:
        run_bench(module, *options.split())
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert said.count("\n") == 1 and words in said


@pytest.mark.usefixtures("data")
def test_scenes_that_are_not_there_get_one_line(capsys):
    test_bad_options_get_one_line("real", "--only m87", "--only", capsys)


def test_a_process_answers_so_too():
    module, options, words = CASES[0]
    result = run_python("-m", f"bench.{module}", *options.split())
    assert result.returncode == 2 and result.stdout == ""
    assert result.stderr.count("\n") == 1 and words in result.stderr


def test_help_can_be_printed(capsys):
    for module in {module for module, *_ in CASES}:
        parser = importlib.import_module(f"bench.{module}").parser()
        with pytest.raises(SystemExit):
            parser.parse_args(["--help"])
        text = capsys.readouterr().out
        assert text.startswith(f"usage: {parser.prog} ") and "--help" in text
