"""The model of a cluster in benches/schedule.py against what can be calculated by hand."""

import importlib.util
import math
import random
import sys
from pathlib import Path

import pytest

FILE = Path(__file__).resolve().parents[2] / "benches/schedule.py"
if not FILE.exists():
    pytest.skip("benches/ is not beside the package", allow_module_level=True)
spec = importlib.util.spec_from_file_location("schedule", FILE)
schedule = sys.modules["schedule"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(schedule)
Cluster, Task, simulate = schedule.Cluster, schedule.Task, schedule.simulate


def test_equal_tasks_run_in_waves_of_all_cores():
    for nodes, cores, tasks in ((1, 1, 5), (3, 4, 12), (3, 4, 13), (2, 7, 3)):
        outcome = simulate(Cluster(nodes, cores), Task(2.5), [1.0] * tasks)
        assert outcome.secs == pytest.approx(2.5 * math.ceil(tasks / (nodes * cores)))
        assert outcome.restarts == 0


def test_more_slots_than_cores_share_the_cores():
    # Four at once on two cores take twice as long, and end together.
    assert simulate(Cluster(1, 2, slots=4), Task(3.0), [1.0] * 8).secs == pytest.approx(12.0)
    # Of five, the last has a core for itself.
    assert simulate(Cluster(1, 2, slots=4), Task(3.0), [1.0] * 5).secs == pytest.approx(9.0)


@pytest.mark.parametrize("network, server, why", [(40.0, math.inf, "network"), (math.inf, 50.0, "server"), (1e6, 1e6, "cores")])
def test_the_slowest_of_cores_network_and_server_decides(network, server, why):
    outcome = simulate(Cluster(2, 3, network=network, server=server), Task(1.0, 100.0), [1.0] * 6)
    expected = {"network": 3 * 100 / 40.0, "server": 6 * 100 / 50.0, "cores": 1.0}[why]
    assert outcome.secs == pytest.approx(expected)
    assert outcome.limited_by[why] == pytest.approx(1.0)


def test_a_server_gives_all_that_a_slow_node_can_take_and_the_rest_to_the_others():
    # Of 30 B/s the slow node takes 5, the other the 20 that it can, and none waits for the server.
    cluster = Cluster(2, 1, server=30.0, slow={0: 4.0})
    assert schedule.shares({5.0: 1, 20.0: 1}, 30.0) == {5.0: 5.0, 20.0: 20.0}
    assert simulate(cluster, Task(1.0, 20.0), [1.0] * 2).secs == pytest.approx(4.0)
    # Of 12, 5 and the rest.
    assert schedule.shares({5.0: 1, 20.0: 1}, 12.0) == {5.0: 5.0, 20.0: 7.0}
    # Everyone the same where all want more.
    assert schedule.shares({10.0: 3, 20.0: 1}, 8.0) == {10.0: 2.0, 20.0: 2.0}


def test_tasks_are_handed_out_one_after_another():
    outcome = simulate(Cluster(1, 100, dispatch_secs=0.5), Task(1.0), [1.0] * 10)
    assert outcome.secs == pytest.approx(9 * 0.5 + 1.0)


def test_what_a_dead_node_had_begun_is_done_again():
    rng = random.Random(3)
    lengths = [math.exp(rng.gauss(0, 0.3)) for _ in range(200)]
    still = simulate(Cluster(3, 2), Task(10.0), lengths)
    dying = simulate(Cluster(3, 2, mean_secs_to_failure=150.0, repair_secs=20.0), Task(10.0), lengths, seed=5)
    assert still.restarts == 0 and dying.restarts > 3 and dying.secs > still.secs
    # All work, and what was lost, fits into the core seconds that there were.
    assert sum(lengths) * 10.0 + dying.lost_core_secs <= dying.secs * 6
    assert 0.0 < dying.lost_core_secs <= dying.restarts * 10.0 * max(lengths)


def test_no_schedule_is_quicker_than_its_bound():
    rng = random.Random(1)
    for _ in range(20):
        cluster = Cluster(rng.randint(1, 5), rng.randint(1, 4), network=rng.uniform(50, 500), server=rng.uniform(50, 2000))
        task, count = Task(rng.uniform(0.5, 2), rng.uniform(10, 200)), rng.randint(1, 60)
        found = simulate(cluster, task, [1.0] * count).secs
        busy = min(count, cluster.nodes * cluster.cores)
        least = max(
            task.secs * math.ceil(count / (cluster.nodes * cluster.cores)),
            count * task.bytes / cluster.server,
            count * task.bytes / (cluster.network * min(cluster.nodes, busy)),
        )
        assert found >= least * (1 - 1e-9)
        assert found <= count * (task.secs + task.bytes / min(cluster.network, cluster.server)) * (1 + 1e-9)
