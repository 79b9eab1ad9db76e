"""Findings of the paper's benchmarks follow from their numbers: sentences, verdicts, reasons."""

import numpy as np
import pytest

METHODS = ("ours", "ours64", "paper", "quintic", "sinc")


def accuracy_numbers(sinc=50.0, wins=0.0, wide=45.0, spread=11.0):
    """Numbers of a run of two pairs in which every statement holds, but for what is given."""
    mean = {"ours": 50.0, "ours64": 50.0, "paper": 50.0, "quintic": 40.0, "sinc": sinc}
    same = {"ours": 76.0, "ours64": np.inf, "paper": 70.0, "quintic": 41.0, "sinc": 60.0}
    pairs = [
        {
            "from": "EUCLID",
            "to": to,
            "n_model": 118,
            "n_galaxies": 9,
            "mean": values,
            "std": dict.fromkeys(METHODS, spread),
            "exact": {name: value == np.inf for name, value in values.items()},
            "quintic_wins": wins,
        }
        for to, values in (("RUBIN", mean), ("EUCLID", same))
    ]
    rows = [
        {"n_model": n, "edge": 1e-4, "ours": s, "quintic": 41.0} for n, s in ((118, 40), (236, 60))
    ]
    worst = {"from": "EUCLID", "to": "RUBIN", "galaxy": 3, "edge_rank": 0.9, "padded": rows}
    worst["wide"] = {"ours": wide, "quintic": 41.0}
    visual = [{"title": "EUCLID → RUBIN", "ours": 50.0, "quintic": 40.0}]
    return {"pairs": pairs, "worst": [worst], "edge_correlation": -0.5, "visual": visual}


@pytest.mark.parametrize(
    ("change", "failing"),
    [
        ({}, ()),
        ({"spread": 1.0}, ("Scatter of the SDR",)),
        ({"sinc": 50.2}, ("Off the diagonal, in float32", "Off the diagonal, in float64")),
        ({"wins": 0.02}, ("Where GalSim's default wins",)),
        ({"wide": 65.0}, ("Why GalSim's default wins there",)),
    ],
)
def test_verdicts_follow_the_numbers(change, failing):
    from bench.paper.accuracy_findings import findings

    found = findings("accuracy", accuracy_numbers(**change))
    assert tuple(f.claim.title for f in found if f.holds is False) == failing
    better = {f.claim.title for f in found if f.holds is False and f.better}
    assert better == {"Scatter of the SDR"}.intersection(failing)
    assert all(isinstance(f.holds, bool) for f in found)


@pytest.mark.parametrize("which", [0, 1], ids=["of two surveys", "of one survey"])
def test_pairs_of_one_kind_are_enough(which):
    """As `--pairs` chooses them."""
    from bench.paper.accuracy_findings import findings

    numbers = accuracy_numbers()
    numbers["pairs"] = numbers["pairs"][which : which + 1]
    found = findings("accuracy", numbers)
    assert found and all("nan" not in f.number + f.found for f in found)


def test_lines_and_slopes_are_found():
    from bench.paper.timing_findings import line_fit, slope

    sizes = [50, 100, 200, 400]
    assert slope(sizes, [9.0] + [1e-8 * n**4 for n in sizes[1:]]) == pytest.approx(4)
    assert slope(sizes[:2], [1, 2]) is None
    rows = timing_numbers()["rows"]
    assert line_fit(rows, "paper") == (pytest.approx((-0.17, 0.048)), pytest.approx(1))


def timing_numbers(faster=1.0, power=4, own_power=2):
    """Numbers of a run with the times of the paper's code, divided by `faster`."""
    sizes = [50, 100, 200, 400]
    rows = [
        {
            "n_model": n,
            "n_obs": n,
            "ms": {
                "quintic": 2.0,
                "paper": 2 * (0.048 * n - 0.17) / faster,
                "ours": 0.1,
                "sinc": s,
            },
        }
        for n, s in ((50, 5.0), (100, 10.0), (200, 18.0 / faster))
    ]
    times = {
        "ours": [n**own_power for n in sizes],
        "paper": [n**power for n in sizes],
        "products": sizes,
    }
    return {"rows": rows, "schemes": [{"angle_deg": 0.0, "n_model": sizes, **times}]}


@pytest.mark.parametrize(
    ("change", "holds", "better"),
    [
        ({}, [True, True, False, True], 2),  # at N = 50 the paper's line is above twice GalSim's
        ({"faster": 1.3}, [True, True, True, True], None),
        ({"faster": 100.0}, [True, True, False, True], 2),
        ({"faster": 1.3, "power": 3}, [True, True, True, False], 3),
        ({"faster": 1.3, "own_power": 4}, [True, True, True, False], None),
    ],
)
def test_verdicts_on_times_follow_the_numbers(change, holds, better):
    from bench.paper.timing_findings import findings

    found = findings(timing_numbers(**change))
    assert [f.holds for f in found] == holds
    failing = [i for i, f in enumerate(found) if not f.holds and f.better]
    assert failing == ([better] if better is not None and change else [])


def finding(holds, *, label="fig:SDR", better=False):
    from bench.paper.finding import Claim, Finding

    return Finding(Claim(label, "", "", ""), "", "", holds, better=better)


def test_a_verdict_says_why_a_statement_does_not_hold():
    from bench.paper.finding import verdict

    yes, no, better = finding(True), finding(False), finding(False, better=True)
    assert verdict(yes) == "Holds."
    assert verdict(finding(None)) == "Not decided."
    assert verdict(no) == "Does not hold: we fall short."
    assert verdict(better) == verdict(better, "setting", yes) == "Does not hold: we are better."
    about = "Does not hold: the statement is about another start"
    assert verdict(no, "start") == f"{about}."
    assert verdict(no, "start", yes) == f"{about}, and from that one it holds."
    assert verdict(no, "start", no) == f"{about}, and from that one we fall short too."
    assert verdict(no, "start", better) == f"{about}, and from that one we are better."
    # what we ask of ourselves is meant for every setting
    assert verdict(finding(False, label=""), "setting", yes) == "Does not hold: we fall short."


def galaxies(n, gain, rng):
    """Magnitudes and SDRs of n galaxies; joint is better than the better survey by `gain`."""
    table = {name: rng.uniform(20, 29, n) for name in ("euclid_mag", "rubin_mag")}
    table["own-euclid"], table["own-rubin"] = 30 - table["euclid_mag"], 30 - table["rubin_mag"]
    better = np.maximum(table["own-euclid"], table["own-rubin"])
    table["own-joint"] = better + gain + 0.1 * rng.standard_normal(n)
    return table


@pytest.mark.parametrize(("gain", "verdict"), [(1.0, True), (0.0, None), (-3.0, False)])
def test_joint_findings_say_what_the_numbers_say(gain, verdict):
    from bench.paper import joint_bins, joint_findings

    table = galaxies(600, gain, np.random.default_rng(3))
    maps = joint_bins.bin_galaxies(table, ["own"])
    assert maps["number"].shape == (6, 6)
    assert maps["number"].sum() == 600
    inside = (table["euclid_mag"] < 21.5) & (table["rubin_mag"] >= 27.5)
    difference = (table["own-joint"] - table["own-rubin"])[inside]
    assert maps["gain"]["own-rubin"][0, -1] == pytest.approx(difference.mean())
    error = difference.std(ddof=1) / np.sqrt(inside.sum())
    assert maps["error"]["own-rubin"][0, -1] == pytest.approx(error)
    numbers = joint_bins.summarise(table, maps, ["own"])
    found = joint_findings.findings("own", numbers)
    gains = next(f for f in found if f.claim is joint_findings.GAIN)
    assert gains.holds is verdict
    assert ("it gains for galaxies bright in both" in gains.found) == (gain > 0)
    assert ("it loses" in gains.found) == (gain < 0)
