"""Engines: every unit is done once, wherever, whoever dies meanwhile; what kills its workers is given up."""

import contextlib
import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import distributed
import pytest

from eval.faults.kills import workers_of
from potlp_jax.engine.cluster import DaskEngine, _give_up_after, _Prepared
from potlp_jax.engine.engine import MOST_KILLED, Broken, Engine, Here
from potlp_jax.engine.opening import BATCH_SYSTEMS, open_engine
from potlp_jax.engine.writer import only_writer
from potlp_jax.errors import EngineError, StoreError, WorldError


def squares(shared: int, unit: int):
    """Results one by one."""
    for step in range(2):
        yield shared + unit * unit + step


def slow_squares(shared: Path, unit: int):
    """A stand-in that says who began it."""
    with (shared / f"{unit}.txt").open("a", encoding="utf-8") as file:
        file.write(f"{os.getpid()}\n")
    time.sleep(0.1)
    yield unit * unit


def deadly(shared: Path, unit: int):
    """Kills its process, in the unit 3."""
    yield from slow_squares(shared, unit)
    if unit == 3:
        os.kill(os.getpid(), signal.SIGKILL)


def failing(shared: None, unit: int):
    """Ends with an error of the library."""
    raise WorldError(f"no world {unit}")
    yield


def cores(shared: None, unit: int):
    """Where the process may run, and who it is."""
    time.sleep(0.2)
    yield os.getpid(), sorted(os.sched_getaffinity(0))


@pytest.fixture(scope="module")
def two():
    """Two processes of this machine."""
    with open_engine(2) as engine:
        yield engine


def test_engines_keep_the_protocol(two):
    assert isinstance(Here(), Engine)
    assert isinstance(two, Engine)
    assert Here().workers == 1


def test_here_results_come_one_by_one_and_units_are_asked_for_late():
    asked = []

    def units():
        for unit in range(3):
            asked.append(unit)
            yield unit

    results = Here().run(squares, 100, units())
    assert [next(results), list(asked)] == [(0, [100]), [0]]
    assert list(results) == [(0, [101]), (1, [101]), (1, [102]), (2, [104]), (2, [105])]


def test_in_processes_every_unit_is_done_and_units_are_asked_for_late(two):
    asked = []

    def units():
        for unit in range(20):
            asked.append(unit)
            yield unit

    results = two.run(squares, 100, units())
    first = next(results)
    assert len(asked) < 20
    found = dict([first, *results])
    assert found == {unit: [100 + unit * unit, 101 + unit * unit] for unit in range(20)}
    assert list(two.run(squares, 100, [])) == []


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores can be chosen on Linux alone")
def test_workers_are_counted_by_the_scheduler_and_not_by_what_dask_remembers(two, monkeypatch, caplog):
    # What it refreshes in the background has no workers in it, and may come between a question and its answer.
    monkeypatch.setattr(distributed.Client, "scheduler_info", lambda self, **options: {"workers": {}})
    monkeypatch.setattr("potlp_jax.engine.cluster._LOOK", 0.0)
    two.look_after_workers()
    assert two.workers == 2
    assert "ended" not in caplog.text


def test_each_worker_keeps_to_a_core(two):
    found = {pid: allowed for _, ((pid, allowed),) in two.run(cores, None, range(8))}
    assert len(found) == 2
    assert all(len(allowed) == 1 for allowed in found.values())
    if len(os.sched_getaffinity(0)) > 1:
        assert len({tuple(allowed) for allowed in found.values()}) == 2


def test_two_who_share_a_scheduler_do_not_share_what_their_units_need(two):
    one, other = two.run(squares, 100, range(6)), two.run(squares, 200, range(6))
    found = [next(one)], [next(other)]
    for results, into in zip((one, other), found, strict=True):
        into.extend(results)
    assert [dict(into) for into in found] == [
        {unit: [shared + unit * unit, shared + unit * unit + 1] for unit in range(6)} for shared in (100, 200)
    ]


def test_what_a_unit_raises_is_raised_here(two):
    with pytest.raises(WorldError, match="no world 5"):
        list(two.run(failing, None, [5]))
    # And the workers are there for others.
    assert list(two.run(squares, 0, [3])) == [(3, [9, 10])]


def test_what_a_unit_raises_is_told_once(capfd):
    with open_engine(2) as engine, pytest.raises(WorldError):
        list(engine.run(failing, None, [5]))
    assert "Traceback" not in capfd.readouterr().err


def allowed_failures(dask_scheduler):
    """How many workers may die of a unit."""
    return dask_scheduler.allowed_failures


def test_a_scheduler_is_left_as_it_was_and_asked_for_the_most_meanwhile(two):
    before = two.client.run_on_scheduler(allowed_failures)
    # Neither the default, nor what a run asks for.
    assert before not in (MOST_KILLED - 2, 0)
    first, second = (contextlib.closing(two.run(squares, 0, range(6))) for _ in range(2))
    with first as one, second as other:
        next(one)
        next(other)
        two.prepare("alone", 0, 1)
        assert two.client.run_on_scheduler(allowed_failures) == MOST_KILLED - 2
    assert two.client.run_on_scheduler(allowed_failures) == 0
    two.restore("alone")
    assert two.client.run_on_scheduler(allowed_failures) == before


def test_what_a_killed_run_asked_of_a_scheduler_is_forgotten(two):
    before = two.client.run_on_scheduler(allowed_failures)
    killed = distributed.Client(two.client.scheduler.address, set_as_default=False)
    killed.run_on_scheduler(_give_up_after, 7, "killed", killed.id)
    assert two.client.run_on_scheduler(allowed_failures) == 6
    # It is gone, and has not said that it is over.
    killed.close()
    two.prepare("next", 0, 1)
    assert two.client.run_on_scheduler(allowed_failures) == 0
    two.restore("next")
    assert two.client.run_on_scheduler(allowed_failures) == before


def test_a_run_that_ends_leaves_what_others_say_and_do_not_say(monkeypatch):
    # What else a worker is told is nothing for this process.
    monkeypatch.setattr("potlp_jax.engine.cluster.enable_compilation_cache", lambda: None)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    one, other = (_Prepared(name, (), None) for name in ("potlp-one", "potlp-other"))
    logger = logging.getLogger("distributed.worker")
    heard, before = [], list(logger.filters)
    listener = logging.Handler()
    listener.emit = lambda record: heard.append(record.getMessage().split()[-1])
    logger.addHandler(listener)
    try:
        for prepared in (one, other):
            prepared.setup(SimpleNamespace(name="worker"))
        for key in ("potlp-one-3", "potlp-other-0", "somebody-else"):
            logger.error("Compute Failed\nKey: %s", key)
        one.teardown(None)
        for key in ("potlp-one-3", "potlp-other-0", "somebody-else"):
            logger.error("Compute Failed\nKey: %s", key)
        other.teardown(None)
    finally:
        logger.removeHandler(listener)
    assert heard == ["somebody-else", "potlp-one-3", "somebody-else"]
    assert logger.filters == before


def test_a_run_that_outlives_its_engine_asks_nobody(monkeypatch):
    with open_engine(2) as engine:
        run = engine.run(squares, 0, range(6))
        next(run)
    # As where an error keeps it until after its engine is closed: who asked would wait.
    for name in ("cancel", "run_on_scheduler"):
        monkeypatch.setattr(engine.client, name, lambda *_, **__: pytest.fail("its scheduler is gone"))
    run.close()


def test_a_unit_that_kills_its_workers_is_given_up_and_the_others_are_done(two, tmp_path):
    found = dict(two.run(deadly, tmp_path, range(6)))
    assert isinstance(found[3], Broken)
    assert found[3].error == "3 workers that began it died"
    assert {unit: result for unit, result in found.items() if unit != 3} == {u: [u * u] for u in (0, 1, 2, 4, 5)}
    begun = (tmp_path / "3.txt").read_text().split()
    assert len(begun) == len(set(begun)) == MOST_KILLED


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="processes are found in /proc")
def test_units_of_a_worker_that_is_killed_go_to_others(two, tmp_path):
    results = two.run(slow_squares, tmp_path, range(30))
    found = dict([next(results)])
    os.kill(workers_of(os.getpid())[0], signal.SIGKILL)
    found |= dict(results)
    assert found == {unit: [unit * unit] for unit in range(30)}


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


@contextlib.contextmanager
def _begun(*words: str):
    process = subprocess.Popen(
        [sys.executable, "-m", "distributed.cli." + words[0], *words[1:]], stderr=subprocess.DEVNULL
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.mark.long
def test_a_scheduler_that_is_killed_and_comes_back_loses_nothing(tmp_path, caplog):
    address = f"tcp://127.0.0.1:{(port := _free_port())}"
    scheduler = "dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"
    worker = "dask_worker", address, "--nthreads", "1", "--no-dashboard", "--death-timeout", "60"
    with contextlib.ExitStack() as stack:
        first = stack.enter_context(_begun(*scheduler))
        stack.enter_context(_begun(*worker))
        engine = stack.enter_context(open_engine(cluster=address))
        results = engine.run(slow_squares, tmp_path, range(20))
        found = dict([next(results)])
        first.send_signal(signal.SIGKILL)
        first.wait()
        stack.enter_context(_begun(*scheduler))
        stack.enter_context(_begun(*worker))
        found |= dict(results)
    assert found == {unit: [unit * unit] for unit in range(20)}
    assert "; what it had been given begins again" in caplog.text


def test_a_cluster_without_workers_is_waited_for_with_a_note(tmp_path, caplog, monkeypatch):
    monkeypatch.setattr("potlp_jax.engine.cluster._REMINDER", 0.5)
    address = f"tcp://127.0.0.1:{(port := _free_port())}"
    with contextlib.ExitStack() as stack:
        stack.enter_context(_begun("dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"))
        engine = stack.enter_context(open_engine(cluster=address))
        assert engine.workers == 0

        worker = "dask_worker", address, "--nthreads", "1", "--no-dashboard"
        later = threading.Timer(3.0, lambda: stack.enter_context(_begun(*worker)))
        later.start()
        assert list(engine.run(squares, 0, [3])) == [(3, [9, 10])]
        later.join()
    assert "no worker is there; waiting for one" in caplog.text


@pytest.mark.parametrize(
    ("cluster", "message"),
    [
        ("mars", r"--cluster mars: unknown; give one of tcp://HOST:PORT, ssh:HOST,HOST, slurm:OPTION=VALUE"),
        ("slurm:partition", "'partition' is no OPTION=VALUE"),
        ("slurm:workers=0", "workers: give a whole number of at least 1, found 0"),
        ("slurm:workers=many", "workers: give a whole number of at least 1, found many"),
        ("slurm:workers=²", "workers: give a whole number of at least 1, found ²"),
        ("slurm:workers=1,colour=red", "workers cannot be begun as jobs of slurm"),
        ("ssh:", "name the machines"),
    ],
)
def test_clusters_that_cannot_be_are_named(cluster, message, monkeypatch):
    pytest.importorskip("dask_jobqueue")
    pytest.importorskip("asyncssh")
    monkeypatch.setattr(shutil, "which", lambda program: f"/usr/bin/{program}")
    with pytest.raises(EngineError, match=message), open_engine(cluster=cluster):
        pass


def test_a_batch_system_that_is_not_here_is_named(monkeypatch):
    jobqueue = pytest.importorskip("dask_jobqueue")
    monkeypatch.setattr(shutil, "which", lambda program: None)
    for name, system in BATCH_SYSTEMS.items():
        assert hasattr(jobqueue, system.cluster)
        with (
            pytest.raises(EngineError, match=f"there is no {system.submit} here"),
            open_engine(cluster=f"{name}:workers=1"),
        ):
            pass


def test_jobs_have_no_limit_of_dask_and_options_as_they_were_given(monkeypatch):
    jobqueue = pytest.importorskip("dask_jobqueue")
    monkeypatch.setattr(shutil, "which", lambda program: f"/usr/bin/{program}")
    made = []

    class Kept(jobqueue.SLURMCluster):
        def __init__(self, **options):
            super().__init__(**options)
            made.append(self)
            raise OSError("enough")

    monkeypatch.setattr(jobqueue, "SLURMCluster", Kept)
    where = (
        "slurm:job_extra_directives=--account=x,cores=4,processes=2,memory=2GB,"
        "worker_extra_args=--local-directory '/tmp/a b'"
    )
    with pytest.raises(EngineError, match="enough"), open_engine(cluster=where):
        pass
    script = made[0].job_script()
    made[0].close()
    assert "#SBATCH --account=x\n" in script
    assert "--cpus-per-task=4\n" in script
    assert "--nworkers 2" in script
    assert "--local-directory '/tmp/a b'" in script
    # Of two the last one counts.
    assert script.rindex("--memory-limit 0") > script.index("--memory-limit 0.93GiB")
    with pytest.raises(EngineError, match="cores: give a whole number of at least 1, found two"):
        open_engine(cluster="slurm:cores=two").__enter__()


def test_workers_that_were_begun_end_where_nobody_can_be_connected_to_them(monkeypatch):
    closed = []

    class Unreachable(distributed.deploy.cluster.Cluster):
        def __init__(self):
            """Nothing is begun."""
            self._cluster_info = {"name": "unreachable"}

        def __repr__(self):
            return "Unreachable"

        def close(self, timeout=None):
            closed.append(self)

    def refuse(*where, **options):
        raise OSError("timed out")

    monkeypatch.setattr(distributed, "Client", refuse)
    with pytest.raises(EngineError, match="no Dask scheduler answers"):
        DaskEngine(Unreachable())
    assert len(closed) == 1


def test_a_connection_is_closed_where_nobody_can_use_it(two, monkeypatch):
    made = []

    class Noted(distributed.Client):
        def __init__(self, *words, **options):
            made.append(self)
            super().__init__(*words, **options)

        def run_on_scheduler(self, *_, **__):
            raise OSError("lost at once")

    monkeypatch.setattr(distributed, "Client", Noted)
    with pytest.raises(OSError, match="lost at once"):
        DaskEngine(two.client.scheduler.address)
    assert [client.status for client in made] == ["closed"]


def test_a_scheduler_that_does_not_answer_is_named(monkeypatch):
    monkeypatch.setattr("potlp_jax.engine.cluster.ANSWER", 0.5)
    where, message = f"tcp://127.0.0.1:{_free_port()}", r"no Dask scheduler answers at tcp://127.0.0.1:\d+ .*scheduler"
    with pytest.raises(EngineError, match=message), open_engine(cluster=where):
        pass


def test_a_folder_has_one_writer_until_its_process_ends_however_it_ends(tmp_path):
    code = (
        "import sys, time; from pathlib import Path; from potlp_jax.engine.writer import only_writer;"
        "from potlp_jax.errors import StoreError\n"
        "with only_writer(Path(sys.argv[1]), StoreError): print('held', flush=True); time.sleep(600)"
    )
    holder = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        refused = pytest.raises(StoreError, match=rf"another command works on it \(process {holder.pid} on .*: wait")
        with refused, only_writer(tmp_path, StoreError):
            pass
    finally:
        holder.kill()
        holder.wait()
    with only_writer(tmp_path, StoreError):
        pass


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(StoreError, match=r"missing.*cannot be written"), only_writer(tmp_path / "missing", StoreError):
        pass
