"""Solves planning fixtures with OR-Tools CP-SAT, to compare `unscrew plan` with it. Needs `pip install ortools`.

    cargo test --release -p cell --test or_tools -- --ignored --nocapture write_problems   # prints a FOLDER
    python crates/cell/tests/or_tools.py FOLDER > crates/cell/tests/fixtures/or_tools.json

The model is built from the tasks' own fields (sides, clear views, arms, strips), not from the planner's gaps.
"""
import datetime
import json
import math
import pathlib
import sys

import ortools
from ortools.sat.python import cp_model

MS = 1000  # CP-SAT wants whole numbers: milliseconds, durations rounded up
TIME_LIMIT_S = 60
WORKERS = 2


def ms(seconds):
    return math.ceil(seconds * MS - 1e-6)


def solve(problem):
    tasks, turn = problem["tasks"], ms(problem["product"]["times_s"]["turn"])
    clearance = problem["station"]["clearance_mm"]
    longest = lambda task: max(max([m["table_s"]] + [a["busy_s"] for a in m["arms"] if a]) for m in task["modes"])
    horizon = sum(ms(longest(t)) + 2 * turn + 3000 for t in tasks)
    model = cp_model.CpModel()
    start = [model.new_int_var(0, horizon, t["name"]) for t in tasks]
    makespan = model.new_int_var(0, horizon, "makespan")
    chosen, table_end = [], []
    by_arm = [[] for _ in problem["station"]["arms"]]
    swept = [[] for _ in by_arm]
    for k, task in enumerate(tasks):
        ways = [model.new_bool_var(f"{k}.{m}") for m in range(len(task["modes"]))]
        model.add_exactly_one(ways)
        chosen.append(ways)
        table = sum(ms(mode["table_s"]) * way for mode, way in zip(task["modes"], ways))
        table_end.append(start[k] + table)
        model.add(makespan >= start[k] + table)
        for mode, way in zip(task["modes"], ways):
            for arm, used in enumerate(mode["arms"]):
                if used:
                    busy = ms(used["busy_s"])
                    model.add(makespan >= start[k] + busy).only_enforce_if(way)
                    by_arm[arm].append(model.new_optional_fixed_size_interval_var(start[k], busy, way, f"{k}.{arm}"))
                    swept[arm].append((k, way, used))
    for intervals in by_arm:
        model.add_no_overlap(intervals)

    def not_before(k, after, literals):
        for mode, way in zip(tasks[k]["modes"], chosen[k]):
            lag = max(0, ms(after["lag_s"] - mode["lead_s"]))
            model.add(start[k] >= table_end[after["task"]] + lag).only_enforce_if([way] + literals)

    for k, task in enumerate(tasks):
        for after in task["after"]:
            not_before(k, after, [])
        if task["after_any"]:
            ways = [model.new_bool_var(f"{k} any {n}") for n in range(len(task["after_any"]))]
            model.add_at_least_one(ways)
            for literal, way in zip(ways, task["after_any"]):
                for after in way:
                    not_before(k, after, [literal])
    for i, a in enumerate(tasks):
        for j, b in enumerate(tasks[:i]):
            if a["unit"] != b["unit"]:
                continue
            turned = a["side"] is not None and b["side"] is not None and a["side"] != b["side"]
            if turned or a["alone"] or b["alone"]:
                gap = turn if turned else 0
                first = model.new_bool_var(f"{i} before {j}")
                model.add(start[j] >= table_end[i] + gap).only_enforce_if(first)
                model.add(start[i] >= table_end[j] + gap).only_enforce_if(~first)
    # the arm on the right and the one on the left in room that is not apart
    if len(swept) == 2:
        for i, way_i, right in swept[0]:
            for j, way_j, left in swept[1]:
                if i == j or right["strip"]["high_mm"] + clearance <= left["strip"]["low_mm"]:
                    continue
                first = model.new_bool_var(f"room {i} before {j}")
                model.add(start[j] >= start[i] + ms(right["strip_s"])).only_enforce_if([way_i, way_j, first])
                model.add(start[i] >= start[j] + ms(left["strip_s"])).only_enforce_if([way_i, way_j, ~first])
    model.minimize(makespan)
    solver = cp_model.CpSolver()
    solver.parameters.max_time_in_seconds = TIME_LIMIT_S
    solver.parameters.num_workers = WORKERS
    status = solver.solve(model)
    return {
        "makespan_s": solver.objective_value / MS,
        "bound_s": solver.best_objective_bound / MS,
        "status": solver.status_name(status).lower(),
        "time_s": round(solver.wall_time, 2),
    }


def main():
    results = {}
    for path in sorted(pathlib.Path(sys.argv[1]).glob("*.json")):
        results[path.stem] = solve(json.loads(path.read_text()))
        print(path.stem, results[path.stem], file=sys.stderr)
    told = {
        "solver": f"OR-Tools CP-SAT {ortools.__version__}",
        "workers": WORKERS,
        "time_limit_s": TIME_LIMIT_S,
        "date": datetime.date.today().isoformat(),
        "fixtures": results,
    }
    print(json.dumps(told, indent=2))


if __name__ == "__main__":
    main()
