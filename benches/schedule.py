"""How long a sweep takes on a cluster: its tasks as discrete events, on nodes that share a file server.

    python3 benches/schedule.py                    # the tables of docs/scale.md
    python3 benches/schedule.py --check [FOLDER]   # the same model against tasks that run here, with target/release/acquire

A task computes while it reads, so it advances at the slower of both: `secs` of one core, `bytes` through its node's network
and from the server. Cores are shared evenly by the tasks of a node, network and server evenly by all that ask for more than
their part (max-min fairness). Between two events all rates are constant. Nodes die at random and come back; what ran on them
is begun again, as `acquire extract` does.

Not in the model: the disk's seeks, caches of the file system, memory bandwidth that cores of a node share, queues of other users.
"""

import argparse
import heapq
import math
import random
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path


@dataclass(frozen=True)
class Cluster:
    """Nodes that are alike, but for their speed."""

    nodes: int
    cores: int
    #: Bytes per second through the network of one node, and from the server to all of them.
    network: float = math.inf
    server: float = math.inf
    #: Tasks at once on a node; None: as many as it has cores.
    slots: int | None = None
    #: By how much a node is slower than the others: {number: factor}.
    slow: dict = field(default_factory=dict)
    #: Mean time between two deaths of a node, and until it is back.
    mean_secs_to_failure: float = math.inf
    repair_secs: float = 600.0
    #: What the engine takes to hand out a task, one after another.
    dispatch_secs: float = 0.0


@dataclass(frozen=True)
class Task:
    """Of one core."""

    secs: float
    bytes: float = 0.0


@dataclass
class Outcome:
    secs: float
    #: Core seconds of tasks that were lost.
    lost_core_secs: float
    restarts: int
    #: Time in which a node's tasks waited for "cores", "network", "server", as parts of the whole; the rest had idle slots.
    limited_by: dict


@dataclass
class Node:
    speed: float
    #: What a task that started when the node did would have done, in tasks of length 1.
    done: float = 0.0
    rate: float = 0.0
    limit: str = ""
    #: (what `done` will be when it ends, number of the task)
    running: list = field(default_factory=list)
    up: bool = True


def shares(demands, capacity):
    """Max-min fair parts of `capacity`, by demand, for {demand: how many ask for that}."""
    left, count, given = capacity, sum(demands.values()), {}
    for demand in sorted(demands):
        given[demand] = min(demand, left / count)
        left, count = left - given[demand] * demands[demand], count - demands[demand]
    return given


def set_rates(nodes, cluster, task):
    """Rates of all nodes, in tasks of length 1 per second and running task."""
    wanted = Counter()
    for node in nodes:
        n = len(node.running)
        if not n or not node.up:
            node.rate = 0.0
            continue
        by_cores = node.speed * min(1.0, cluster.cores / n) / task.secs if task.secs else math.inf
        by_network = cluster.network / n / task.bytes if task.bytes else math.inf
        node.rate, node.limit = min((by_cores, "cores"), (by_network, "network"))
        wanted[node.rate * task.bytes] += n
    given = shares(wanted, cluster.server)
    for node in nodes:
        demand = node.rate * task.bytes
        if node.rate and demand > 0 and given[demand] < demand * (1 - 1e-12):
            node.rate, node.limit = given[demand] / task.bytes, "server"


def simulate(cluster, task, lengths, seed=1):
    """`lengths`: of every task, in units of `task`."""
    rng = random.Random(seed)
    nodes = [Node(1.0 / cluster.slow.get(k, 1.0)) for k in range(cluster.nodes)]
    slots = cluster.slots or cluster.cores
    waiting = list(range(len(lengths)))[::-1]
    now, ended, restarts, lost = 0.0, 0, 0, 0.0
    handed_out_at = 0.0
    limited = {"cores": 0.0, "network": 0.0, "server": 0.0}
    events = []  # (when, number of the node, what)
    if math.isfinite(cluster.mean_secs_to_failure):
        for k in range(len(nodes)):
            heapq.heappush(events, (rng.expovariate(1 / cluster.mean_secs_to_failure), k, "dies"))
    changed = True
    while ended < len(lengths):
        # Hand out what waits to the emptiest nodes, as engines do.
        free = [(len(node.running), k) for k, node in enumerate(nodes) if node.up and len(node.running) < slots]
        heapq.heapify(free)
        while waiting and free and handed_out_at <= now:
            busy, k = heapq.heappop(free)
            number = waiting.pop()
            heapq.heappush(nodes[k].running, (nodes[k].done + lengths[number], number))
            handed_out_at = max(handed_out_at, now) + cluster.dispatch_secs
            changed = True
            if busy + 1 < slots:
                heapq.heappush(free, (busy + 1, k))
        if changed:
            set_rates(nodes, cluster, task)
            changed = False
        ends = min(((n.running[0][0] - n.done) / n.rate for n in nodes if n.rate), default=math.inf)
        step = min(ends, events[0][0] - now if events else math.inf)
        if waiting and free:
            step = min(step, handed_out_at - now)
        assert math.isfinite(step), "nothing can go on"
        step = max(step, 0.0)
        for node in nodes:
            if node.rate:
                node.done += node.rate * step
                limited[node.limit] += step
        now += step
        for node in nodes:
            while node.running and node.running[0][0] <= node.done * (1 + 1e-12):
                heapq.heappop(node.running)
                ended, changed = ended + 1, True
        while events and events[0][0] <= now:
            _, k, what = heapq.heappop(events)
            node, changed = nodes[k], True
            node.up = what == "returns"
            wait = cluster.mean_secs_to_failure if node.up else cluster.repair_secs
            heapq.heappush(events, (now + (rng.expovariate(1 / wait) if node.up else wait), k, "dies" if node.up else "returns"))
            for end, number in node.running:
                lost += (lengths[number] - (end - node.done)) * task.secs
                waiting.append(number)
                restarts += 1
            node.running = []
    total = now * cluster.nodes
    return Outcome(now, lost, restarts, {k: v / total for k, v in limited.items()} if total else limited)


# Measured (docs/scale.md, docs/reliability.md): processor seconds and bytes of a photograph of 24 Mpx, processor seconds
# of a task besides its photographs, bytes of the prepared file that each task reads.
PHOTOGRAPHS, PHOTOGRAPH_SECS, PHOTOGRAPH_BYTES = 1_050_000, 1.8, 86e6
START_SECS, START_BYTES = 0.15, 12e6
# A node: 16 cores, 10 Gbit/s. What Dask's documentation says of a task: about 1 ms.
NODE = Cluster(1, 16, network=1.25e9, dispatch_secs=1e-3)
SERVERS = {"5 GB/s": 5e9, "90 GB/s": 90e9}


def sweep_task(photographs):
    return Task(START_SECS + photographs * PHOTOGRAPH_SECS, START_BYTES + photographs * PHOTOGRAPH_BYTES)


def sweep(cluster, photographs, spread=0.03, seed=1):
    """The tasks of `extract`; their lengths differ by `spread`, as four parts of one capture did (1.52 to 1.66 s)."""
    rng = random.Random(seed)
    lengths = [math.exp(rng.gauss(0, spread)) for _ in range(math.ceil(PHOTOGRAPHS / photographs))]
    return simulate(cluster, sweep_task(photographs), lengths, seed)


def bound(cluster):
    """What no schedule can be quicker than, and why."""
    read = PHOTOGRAPHS * PHOTOGRAPH_BYTES
    return max(
        (PHOTOGRAPHS * PHOTOGRAPH_SECS / (cluster.nodes * cluster.cores), "cores"),
        (read / (cluster.nodes * cluster.network), "network"),
        (read / cluster.server, "server"),
    )


def told(secs):
    return f"{secs / 3600:.2f} h" if secs >= 5400 else f"{secs / 60:.1f} min" if secs >= 90 else f"{secs:.1f} s"


def tables():
    print("extract of 1,050,000 photographs of 24 Mpx; four tasks a core or more, at most 1,000 photographs each\n")
    print("| nodes, server | photographs a task | no schedule is quicker than | scheduled | tasks wait for | a node dies every 1,000 h | one node at half speed |")
    print("|---|---|---|---|---|---|---|")
    for nodes in (1, 16, 256):
        for name, server in SERVERS.items():
            cluster = replace(NODE, nodes=nodes, server=server)
            least, why = bound(cluster)
            size = min(1000, PHOTOGRAPHS // (4 * nodes * cluster.cores))
            plain = sweep(cluster, size)
            dying = sweep(replace(cluster, mean_secs_to_failure=3.6e6), size)
            slow = told(sweep(replace(cluster, slow={0: 2.0}), size).secs) if nodes > 1 else "–"
            waits = ", ".join(f"{k} {v:.0%}" for k, v in plain.limited_by.items() if v >= 0.005)
            print(f"| {nodes}, {name} | {size} | {told(least)} ({why}) | {told(plain.secs)} | {waits} | {told(dying.secs)}, {dying.restarts} tasks again | {slow} |")
    print("\nTimes of what no schedule is quicker than, by photographs a task; a node dies every 100 h and is back after 600 s (mean of three seeds)\n")
    sizes = (25, 64, 250, 1000, 5000)
    print("| nodes, server | " + " | ".join(f"{s:,}" for s in sizes) + " |\n|---|" + "---|" * len(sizes))
    for nodes, name in ((16, "5 GB/s"), (16, "90 GB/s"), (256, "90 GB/s")):
        cluster = replace(NODE, nodes=nodes, server=SERVERS[name], mean_secs_to_failure=3.6e5)
        mean = lambda size: statistics.mean(sweep(cluster, size, seed=s).secs for s in range(1, 4)) / bound(cluster)[0]
        print(f"| {nodes}, {name} | " + " | ".join(f"{mean(size):.2f}" for size in sizes) + " |")


def run_here(program, prepared, folder, parts, workers):
    """Wall seconds of all parts, by `workers` at once."""
    for part in folder.glob("*.part"):
        part.unlink()
    waiting, running = list(range(1, parts + 1)), []
    start = time.perf_counter()
    while waiting or running:
        while waiting and len(running) < workers:
            k = waiting.pop(0)
            command = [program, "--quiet", "--threads", "1", "extract", prepared, "--part", f"{k}/{parts}", "--out", folder / f"{k}.part"]
            running.append(subprocess.Popen(list(map(str, command))))
        time.sleep(0.002)
        for process in [process for process in running if process.poll() is not None]:
            running.remove(process)
            if process.returncode:
                sys.exit(f"error: acquire extract: exit status {process.returncode}")
    return time.perf_counter() - start


def check(program, folder):
    """One worker with 1 and with 33 parts gives the two figures of the model; it foretells all else."""
    capture, prepared = folder / "capture", folder / "common.prepared"
    simulated = "--material chessboard-4x4 --grid 26x22 --window 25x21 --lit-pitch-mm 1.5 --seed 1"
    subprocess.run([program, "--quiet", "simulate", capture, *simulated.split()], check=True)
    subprocess.run([program, "--quiet", "prepare", capture, "--out", prepared], check=True)
    parts = folder / "parts"
    parts.mkdir()
    run_here(program, prepared, parts, 2, 2)  # the files into the system's cache
    one = statistics.median(run_here(program, prepared, parts, 1, 1) for _ in range(3))
    many = statistics.median(run_here(program, prepared, parts, 33, 1) for _ in range(3))
    start = (many - one) / 32
    print(f"a task {start:.3f} s, all photographs {one - start:.2f} s on one core\n")
    print("| parts | workers | measured | simulated | ratio |\n|---|---|---|---|---|")
    for count in (4, 16, 64):
        for workers in (1, 2, 3, 4):
            task = Task(start + (one - start) / count)
            told_secs = simulate(Cluster(1, 2, slots=workers), task, [1.0] * count).secs
            measured = statistics.median(run_here(program, prepared, parts, count, workers) for _ in range(3))
            print(f"| {count} | {workers} | {measured:.2f} s | {told_secs:.2f} s | {measured / told_secs:.2f} |")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", nargs="?", const="", metavar="FOLDER")
    options = parser.parse_args()
    if options.check is None:
        return tables()
    program = Path(__file__).resolve().parents[1] / "target/release/acquire"
    with tempfile.TemporaryDirectory(dir=options.check or None) as folder:
        check(program, Path(folder))


if __name__ == "__main__":
    sys.exit(main())
