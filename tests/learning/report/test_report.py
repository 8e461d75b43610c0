"""The report: runs pooled as the textbook says, the paper's numbers, and what cannot be pooled."""

from __future__ import annotations

import csv
import json
import math
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fixtures.evaluated_runs import AGENT, LINE, PLAYED_TOO, RING, SCHEDULE, result, write_run
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from learning.evaluation.paper_results import read_paper
from learning.policy.policy import AGENTS
from learning.report.cells import CurvePoint, pool, version_notes
from learning.report.curves import draw_curves
from learning.report.read import read_runs
from learning.report.report import write_report
from learning.report.tables import compared
from warp_deform.command.main import main
from warp_deform.errors import InputError
from warp_deform.tasks.registration import env_id
from warp_deform.tasks.registry import TASKS


def cells(*paths: Path) -> list[Any]:
    return pool(read_runs(paths)[0], read_paper())


def test_the_papers_table_is_whole() -> None:
    paper = read_paper()
    assert set(paper.measures) <= set(TASKS) and len(paper.measures) == 13
    assert paper.demos == (1, 10, 100, 1000)
    papers = {"transporter", "goal-split", "goal-stack", "gt-mlp", "gt-mlp-2step"}
    assert {agent for _, agent, _ in paper.values} == papers <= set(AGENTS)
    # 8 tasks with 3 agents and 5 with 4, at 4 numbers of demonstrations
    assert len(paper.values) == (8 * 3 + 5 * 4) * 4
    assert all(0 <= value <= 100 for value in paper.values.values())
    assert paper.values[LINE, "goal-stack", 10] == 99.7
    assert paper.values["block-notarget", "gt-mlp-2step", 1000] == 90.0
    assert paper.values["bag-color-goal", "goal-split", 100] == 0.0
    assert paper.measures[LINE] == "mean partial score" and paper.measures[RING] == "success"


def test_seeds_are_pooled(tmp_path: Path) -> None:
    write_run(tmp_path / "a", seed=0, scores=(1.0, 1.0, 1.0, 0.2))
    write_run(tmp_path / "b", seed=1, scores=(1.0, 0.4, 0.4, 0.4))
    (cell,) = cells(tmp_path)
    assert cell.seeds == (0, 1) and (cell.n_success, cell.n_episodes) == (4, 8)
    n, p, z = 8, 0.5, 1.959963984540054
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    assert cell.pc_success_ci95 == pytest.approx((100 * (centre - half), 100 * (centre + half)))
    assert cell.mean_score == pytest.approx((0.8 + 0.55) / 2)
    # between runs: the standard deviation of two means over the root of 2
    assert cell.standard_error == pytest.approx(np.std([0.8, 0.55], ddof=1) / math.sqrt(2))
    assert cell.value == pytest.approx(67.5) and cell.paper == 99.7
    assert cell.failures == {"other": 4}


def test_runs_that_happen_to_agree_are_as_uncertain_as_their_episodes(tmp_path: Path) -> None:
    scores = (1.0, 0.8, 0.6, 0.2)
    for seed in (0, 1):
        write_run(tmp_path / str(seed), seed=seed, scores=scores)
    (cell,) = cells(tmp_path)
    of_one = np.std(scores, ddof=1) / math.sqrt(4)
    assert cell.standard_error == pytest.approx(of_one / math.sqrt(2))


def test_one_run_keeps_its_own_error_and_curve(tmp_path: Path) -> None:
    (cell,) = cells(write_run(tmp_path / "a", task=RING, agent="transporter"))
    assert cell.measure == "success" and cell.value == 50.0
    assert cell.value_error == pytest.approx(100 * math.sqrt(0.25 / 3))
    assert [point.step for point in cell.validation] == [0, 2000, 4000]
    assert cell.validation[0] == CurvePoint(0, 0.0, 0.0)
    assert cell.validation[2].value == 50.0 and cell.test == ()


def test_the_papers_protocol_is_the_best_mean_over_runs(tmp_path: Path) -> None:
    """Not the mean of every run's best, and never the untrained network."""
    curves = {"0": [1.0, 1.0], "2000": [0.9, 0.1]}, {"0": [1.0, 1.0], "2000": [0.1, 0.3]}
    later = [0.2, 0.4], [0.8, 0.6]
    for seed, (curve, last) in enumerate(zip(curves, later, strict=True)):
        snapshots = {k: result(LINE, v) for k, v in (curve | {"4000": last}).items()}
        paper = {"snapshots": snapshots, "stage_rule": "privileged"}
        write_run(tmp_path / str(seed), seed=seed, paper=paper)
    (cell,) = cells(tmp_path)
    assert cell.paper_protocol == pytest.approx(50.0) and cell.paper_protocol_runs == 2
    assert [point.value for point in cell.test] == pytest.approx([100.0, 35.0, 50.0])


def test_what_differs_stays_apart(tmp_path: Path) -> None:
    write_run(tmp_path / "a")
    write_run(tmp_path / "b", stage_rule="privileged")
    write_run(tmp_path / "c", schedule={**SCHEDULE, "steps": 100}, trained_steps=100)
    write_run(tmp_path / "d", retry=False, goals="given, 0123")
    write_run(tmp_path / "e", robot="panda", demos=30)
    pooled = cells(tmp_path)
    assert {(cell.variant, cell.demos) for cell in pooled} == {
        ("fast", 10),
        ("fast, privileged lift", 10),
        ("fast, 100 steps", 10),
        ("fast, no retries, goals given, 0123", 10),
        ("fast, panda", 30),
    }
    tables = compared(pooled, read_paper())
    assert tables["fast, panda"][0][3:] == ["1", "10", "30", "100", "1000"]
    rows = {row[1]: row[3:] for row in tables["fast"]}
    assert rows["goal-stack"] == ["- (91.0)", "75.0 (99.7)", "- (100.0)", "- (100.0)"]
    assert rows["gt-mlp"][0] == "- (9.4)"


def test_runs_that_are_not_one_are_refused(tmp_path: Path) -> None:
    write_run(tmp_path / "x" / "a")
    write_run(tmp_path / "x" / "b")
    with pytest.raises(InputError, match="both seed 0"):
        cells(tmp_path / "x")
    assert len(cells(tmp_path / "x" / "a", tmp_path / "x" / "a")) == 1, "named twice, counted once"
    write_run(tmp_path / "y" / "a")
    write_run(tmp_path / "y" / "b", seed=1, schedule={**SCHEDULE, "lr": 0.5})
    with pytest.raises(InputError, match="differ in schedule"):
        cells(tmp_path / "y")


def test_who_demonstrated_and_how_long_is_a_variant(tmp_path: Path) -> None:
    write_run(tmp_path / "a", trained={"demonstrators": ["scripted"]})
    write_run(tmp_path / "b", seed=1)
    write_run(tmp_path / "c", trained={"demonstrators": ["refined"]})
    write_run(tmp_path / "d", trained={"demonstrators": ["original", "scripted"]})
    write_run(tmp_path / "i", trained={"goal": "own"})
    write_run(tmp_path / "j", seed=1, trained={"goal": "own", "given_goals": 10})
    write_run(tmp_path / "k", trained={"given_goals": 1})
    patient = {"patience": 2, "validate": 20}
    write_run(tmp_path / "e", trained=patient, trained_steps=2000)
    write_run(tmp_path / "f", seed=1, trained=patient, trained_steps=3000)
    write_run(tmp_path / "g", schedule={**SCHEDULE, "steps": 8000})
    write_run(
        tmp_path / "h",
        seed=2,
        trained={"rounded": "bfloat16"},
        snapshots={"4000": result(LINE, [1.0, 1.0, 0.5, 0.5])},
    )
    assert {cell.variant: cell.seeds for cell in cells(tmp_path)} == {
        "fast": (0, 1, 2),
        "fast, refined demonstrations": (0,),
        "fast, original and scripted demonstrations": (0,),
        "fast, goals of their own": (0,),
        "fast, goals of their own, goals given": (1,),
        "fast, goals given to 1 of them": (0,),
        "fast, up to 4000 steps, patience 2": (0, 1),
        "fast, 4000 of 8000 steps": (0,),
    }


def test_steps_are_told_where_they_are_not_the_presets(tmp_path: Path) -> None:
    seen = {"task": LINE, "agent": "gt-mlp", "config": {}, "state_size": 144}
    baseline = {"agent": "gt-mlp", "trained": {"agent": seen}}
    short, paper = ({**SCHEDULE, "steps": steps} for steps in (2000, 20_000))
    write_run(tmp_path / "a")
    write_run(tmp_path / "b", schedule=short, trained_steps=2000)
    write_run(tmp_path / "c", schedule=paper, trained_steps=20_000, **baseline)
    write_run(tmp_path / "d", **baseline)
    write_run(tmp_path / "e", preset="paper", schedule=paper, trained_steps=20_000)
    write_run(tmp_path / "f", preset="of another version")
    assert {(cell.variant, cell.agent) for cell in cells(tmp_path)} == {
        ("fast", "goal-stack"),
        ("fast", "gt-mlp"),
        ("fast, 2000 steps", "goal-stack"),
        ("fast, 4000 steps", "gt-mlp"),
        ("paper", "goal-stack"),
        ("of another version, 4000 steps", "goal-stack"),
    }


@pytest.mark.parametrize(
    ("trained", "info", "difference"),
    [
        ({"agent": {**AGENT, "config": {"exact": True}}}, {}, "agent"),
        ({"augment": False}, {}, "augment"),
        ({}, {"environment": "WarpDeform/CableLineNotarget-v1"}, "environment"),
        ({}, {"test": result(LINE, [1.0] * 5)}, "test episodes"),
        ({}, {"snapshots": {"4000": result(LINE, [1.0] * 5)}}, "validation episodes"),
        ({}, {"paper": {**PLAYED_TOO, "stage_rule": "privileged"}}, "who chooses the lift"),
    ],
)
def test_runs_of_a_cell_are_alike(
    tmp_path: Path, trained: dict[str, Any], info: dict[str, Any], difference: str
) -> None:
    paper = {"paper": {**PLAYED_TOO, "stage_rule": "action"}}
    write_run(tmp_path / "a", **(paper if "paper" in info else {}))
    write_run(tmp_path / "b", seed=1, trained=trained, **info)
    with pytest.raises(InputError, match=f"differ in {difference}"):
        cells(tmp_path)


@pytest.mark.parametrize(
    ("trained", "said"),
    [
        ({"versions": {"warp-deform": "1.0.0", "torch": "9.9.9"}}, "torch, 2.13.0, 9.9.9"),
        ({"device": "cuda"}, "devices, cpu, cuda"),
        ({"agent": {**AGENT, "config": {"bfloat16": True}}}, "precisions, bfloat16, float32"),
    ],
)
def test_runs_that_were_computed_differently_are_pooled_and_noted(
    tmp_path: Path, trained: dict[str, Any], said: str
) -> None:
    write_run(tmp_path / "a")
    write_run(tmp_path / "b", seed=1, trained=trained)
    write_run(tmp_path / "c", demos=100, trained=trained)
    assert [cell.seeds for cell in cells(tmp_path)] == [(0, 1), (0,)]
    (note,) = version_notes(read_runs([tmp_path])[0])
    assert said in note and "10 demonstrations" in note
    report = write_report([tmp_path], None)
    assert report.data["notes"] == [note] and note in report.text


def test_a_rule_of_stopping_counts_where_it_could_stop_a_training(tmp_path: Path) -> None:
    """Two rules of what has to be solved, and no snapshot that solved anything near it."""
    for name, seed, confirm in (("a", 0, 0), ("b", 1, 40)):
        write_run(
            tmp_path / name,
            seed=seed,
            trained={"validate": 20},
            schedule={**SCHEDULE, "confirm": confirm},
        )
    assert [cell.seeds for cell in cells(tmp_path)] == [(0, 1)]
    for name, seed, confirm in (("c", 0, 0), ("d", 1, 40)):
        write_run(
            tmp_path / "solved" / name,
            seed=seed,
            trained={"validate": 20},
            schedule={**SCHEDULE, "confirm": confirm},
            snapshots={"4000": result(LINE, [1.0] * 4)},
        )
    with pytest.raises(InputError, match="further ones that confirm"):
        cells(tmp_path / "solved")
    write_run(  # the first one that is read, to which the rule never came, changes nothing
        tmp_path / "solved" / "a", seed=2, trained={"validate": 20}, schedule=SCHEDULE
    )
    with pytest.raises(InputError, match="further ones that confirm"):
        cells(tmp_path / "solved")
    write_run(
        tmp_path / "early" / "a", trained={"validate": 20}, schedule=SCHEDULE, trained_steps=2000
    )
    write_run(
        tmp_path / "early" / "b",
        seed=1,
        trained={"validate": 20},
        schedule={**SCHEDULE, "confirm": 40},
        trained_steps=2000,
    )
    with pytest.raises(InputError, match="further ones that confirm"):
        cells(tmp_path / "early")


def test_a_result_of_an_earlier_version_of_the_task_is_noted(tmp_path: Path) -> None:
    write_run(tmp_path / "a")
    write_run(tmp_path / "b", demos=100, environment="WarpDeform/CableLineNotarget-v0")
    write_run(tmp_path / "c", demos=1, environment=None)  # of a release that did not say
    report = write_report([tmp_path], None)
    (note,) = report.data["notes"]
    assert "100 demonstrations" in note and "CableLineNotarget-v0" in note
    assert env_id(LINE) in note and note in report.text


def test_a_privileged_lift_is_labelled(tmp_path: Path) -> None:
    snapshots = {"4000": result(LINE, [1.0, 0.0])}
    write_run(tmp_path / "a", paper={"snapshots": snapshots, "stage_rule": "privileged"})
    report = write_report([tmp_path / "a"], tmp_path / "out")
    assert report.data["cells"][0]["paper_protocol_stage_rule"] == "privileged"
    assert "50.0 (privileged lift)" in report.text
    (row,) = csv.DictReader((tmp_path / "out" / "report.csv").read_text().splitlines())
    assert row["paper_protocol_stage_rule"] == "privileged"


def test_every_variant_is_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in range(9):
        write_run(tmp_path / str(number), goals=f"given, {number}")
    drawn = []
    monkeypatch.setattr(Axes, "errorbar", lambda axes, *_, label, **__: drawn.append(label))
    draw_curves(cells(tmp_path), read_paper(), tmp_path)
    assert len(set(drawn)) == 9


def test_the_legend_covers_no_curve_and_tells_all_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    long = "goals that were given by hand, a long name"
    for number, (goals, demos) in enumerate(product(("end", long, "own", "none"), (1, 10, 100))):
        write_run(tmp_path / str(number), goals=goals, demos=demos)
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    draw_curves(cells(tmp_path), read_paper(), tmp_path)
    assert len(figures) == 2
    for figure in figures:
        figure.draw_without_rendering()
        (axes,), (legend,) = figure.axes, figure.legends
        box = legend.get_window_extent()
        assert box.y1 <= axes.get_tightbbox().y0
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= figure.bbox.x1
    lines = figures[0].axes[0].lines
    assert len({(str(each.get_color()), each.get_marker()) for each in lines}) == 12


def test_folders_without_results(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no folder"):
        read_runs([tmp_path / "none"])
    with pytest.raises(InputError, match="holds no training run"):
        read_runs([tmp_path])
    run = write_run(tmp_path / "a")
    (run / "eval_info.json").unlink()
    with pytest.raises(InputError, match="no run is evaluated"):
        read_runs([tmp_path])
    write_run(tmp_path / "b")
    runs, notes = read_runs([tmp_path])
    assert [each.path.name for each in runs] == ["b"] and "not evaluated" in notes[0]
    for changes in (None, {"snapshots": {"a": 1}}, {"paper": {}}, {"test": {"n_episodes": 0}}):
        whole = json.loads((tmp_path / "b" / "eval_info.json").read_text())
        spoilt = {"task": "cable-ring"} if changes is None else whole | changes
        (run / "eval_info.json").write_text(json.dumps(spoilt))
        with pytest.raises(InputError, match="evaluate again"):
            read_runs([tmp_path])


def test_the_command_writes_tables_and_curves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in (0, 1):
        for demos in (1, 10):
            write_run(tmp_path / f"runs/{demos}-{seed}", seed=seed, demos=demos)
    write_run(tmp_path / "runs/ring", task=RING, agent="transporter")
    out = tmp_path / "out"
    assert main(["report", str(tmp_path / "runs"), "--out", str(out), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["runs"] == 5 and len(answer["cells"]) == 3
    assert sorted(Path(name).name for name in answer["files"]) == sorted(
        path.name for path in out.iterdir()
    )
    text = (out / "report.md").read_text()
    assert "75.0 (91.0)" in text and "optimistic" in text and f"steps_{LINE}.png" in text
    rows = list(csv.DictReader((out / "report.csv").read_text().splitlines()))
    assert [row["task"] for row in rows] == [RING, LINE, LINE]
    assert rows[1]["paper_percent"] == "91.0" and rows[1]["table_percent"] == "75.0"
    assert rows[1]["seeds"] == "0 1" and rows[1]["failures_other"] == "4"
    runs = list(csv.DictReader((out / "runs.csv").read_text().splitlines()))
    assert [(row["task"], row["seed"]) for row in runs].count((LINE, "1")) == 2
    assert {(row["n_success"], row["n_episodes"]) for row in runs} == {("2", "4")}
    tex = (out / "report.tex").read_text()
    assert tex.count(r"\begin{tabular}") == tex.count(r"\end{tabular}") == 2
    assert r"success \%" in tex
    for path in out.glob("*.png"):
        picture = cv2.imread(str(path))
        assert picture.shape[0] > 300 and picture.std() > 5


def test_the_same_runs_give_the_same_files(tmp_path: Path) -> None:
    write_run(tmp_path / "a")
    for name in ("x", "y"):
        write_report([tmp_path / "a"], tmp_path / name)
    for path in (tmp_path / "x").iterdir():
        assert path.read_bytes() == (tmp_path / "y" / path.name).read_bytes()


def test_bad_arguments_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    run = write_run(tmp_path / "a")
    for arguments in ([], [str(tmp_path / "none")], [str(run), "--out", str(tmp_path / "file/x")]):
        assert main(["report", *arguments]) == 2
        said = capsys.readouterr()
        assert said.err.count("\n") == 1 and not said.out
