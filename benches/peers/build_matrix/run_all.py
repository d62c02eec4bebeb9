"""`acquire build-matrix` and the pipeline in Python on one capture, in turn; a JSON line a run, then a table of medians.

python run_all.py ACQUIRE CAPTURE WORK ROUNDS
"""

import json
import os
import statistics
import subprocess
import sys
import threading
import time

acquire, capture, work, rounds = *sys.argv[1:4], int(sys.argv[4])
here = os.path.dirname(os.path.abspath(__file__))


def processes(root):
    """The process and those below it."""
    parents = {}
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            with open(f"/proc/{pid}/stat") as stat:
                parents.setdefault(int(stat.read().rsplit(")", 1)[1].split()[1]), []).append(int(pid))
        except OSError:
            pass
    found = [root]
    for pid in found:
        found += parents.get(pid, [])
    return found


def peak_memory(root, done, peak):
    """Largest sum of proportional sizes, KiB: pages that processes share count once."""
    while not done.wait(0.1):
        total = 0
        for pid in processes(root):
            try:
                with open(f"/proc/{pid}/smaps_rollup") as lines:
                    total += next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
            except (OSError, StopIteration):
                pass
        peak[0] = max(peak[0], total)


def measured(command):
    """Wall and processor seconds, and peak memory in MiB, of a command with the processes that it starts."""
    start = time.perf_counter()
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    done, peak = threading.Event(), [0]
    watch = threading.Thread(target=peak_memory, args=(child.pid, done, peak))
    watch.start()
    output, errors = child.stdout.read(), child.stderr.read()
    _, status, used = os.wait4(child.pid, 0)
    wall = time.perf_counter() - start
    done.set()
    watch.join()
    if status != 0:
        raise SystemExit(f"{command}: {errors.decode()}")
    cost = {"secs": round(wall, 2), "cpu_secs": round(used.ru_utime + used.ru_stime, 2), "peak_mib": peak[0] // 1024}
    return cost, output.decode()


def error_of(matrix):
    truth = os.path.join(capture, "truth.rd.zarr")
    measures = json.loads(subprocess.check_output([acquire, "evaluate", "--json", matrix, truth], stderr=subprocess.DEVNULL))
    return {k: round(measures[k], 5) for k in ("rel_rmse", "log_rmse", "relit_psnr_db", "position_rms_mm")}


def ours():
    out = os.path.join(work, "ours.rd.zarr")
    cost, _ = measured([acquire, "build-matrix", capture, "--out", out, "--force", "--quiet"])
    return cost | error_of(out)


def python():
    archive, out = os.path.join(work, "python.npz"), os.path.join(work, "python.rd.zarr")
    cost, printed = measured([sys.executable, os.path.join(here, "pipeline.py"), capture, archive])
    subprocess.check_call([acquire, "import-matrix", archive, "--out", out, "--force", "--quiet"], stderr=subprocess.DEVNULL)
    return cost | error_of(out) | json.loads(printed)


runs = {"acquire": [], "python": []}
for round_ in range(rounds):
    for name, pipeline in (("acquire", ours), ("python", python)):
        runs[name].append(pipeline())
        print(json.dumps({"pipeline": name, "round": round_} | runs[name][-1]), flush=True)

print("| | wall, s | processor, s | peak memory, MiB | rel_rmse | log_rmse | relit_psnr_db | position_rms_mm |")
print("|---|---|---|---|---|---|---|---|")
columns = ("secs", "cpu_secs", "peak_mib", "rel_rmse", "log_rmse", "relit_psnr_db", "position_rms_mm")
for name, all_runs in runs.items():
    print(f"| {name} | " + " | ".join(f"{statistics.median(r[c] for r in all_runs):.4g}" for c in columns) + " |")
for column in ("secs", "cpu_secs"):
    ratios = [p[column] / o[column] for o, p in zip(runs["acquire"], runs["python"])]
    print(f"python / acquire, {column}: median {statistics.median(ratios):.2f} of {[round(r, 2) for r in ratios]}")
