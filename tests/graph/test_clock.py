"""A host's clock that is set back or forward in the middle of a run: nobody stops for it, and no weight changes."""

from __future__ import annotations

import mmap
import shutil
import struct
import subprocess

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from harness import SMALL, Listener, oracle
from std_srvs.srv import Trigger

from dae_ros.ros import names, qos

HOUR = 3600  # s
SHIM = r'''
#include <fcntl.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static volatile long *shift;  /* s, shared by all processes */

__attribute__((constructor)) static void find_shift(void) {
  int file = open(getenv("CLOCK_SHIFT"), O_RDONLY);
  void *found = mmap(0, sizeof(long), PROT_READ, MAP_SHARED, file, 0);
  close(file);
  if (found != MAP_FAILED) shift = found;
}

int clock_gettime(clockid_t clock, struct timespec *now) {
  int failed = syscall(SYS_clock_gettime, clock, now);
  if (!failed && clock == CLOCK_REALTIME && shift) now->tv_sec += *shift;
  return failed;
}

int gettimeofday(struct timeval *restrict now, void *restrict zone) {
  struct timespec time;
  clock_gettime(CLOCK_REALTIME, &time);
  now->tv_sec = time.tv_sec;
  now->tv_usec = time.tv_nsec / 1000;
  return 0;
}

time_t time(time_t *now) {
  struct timespec time;
  clock_gettime(CLOCK_REALTIME, &time);
  if (now) *now = time.tv_sec;
  return time.tv_sec;
}
'''


@pytest.fixture
def set_clock(tmp_path, monkeypatch):
    """Sets the clock of all processes started from here on, by seconds from the true time, also while they run."""
    compiler = shutil.which('cc')
    if compiler is None:
        pytest.skip('there is no C compiler here')
    source, library, file = (tmp_path / name for name in ('clock.c', 'clock.so', 'shift'))
    source.write_text(SHIM)
    subprocess.run([compiler, '-shared', '-fPIC', '-o', str(library), str(source)], check=True)
    file.write_bytes(bytes(8))
    monkeypatch.setenv('CLOCK_SHIFT', str(file))
    monkeypatch.setenv('LD_PRELOAD', str(library))
    with open(file, 'r+b') as opened, mmap.mmap(opened.fileno(), 8) as shift:
        yield lambda seconds: shift.__setitem__(slice(0, 8), struct.pack('=q', seconds))


@pytest.mark.parametrize('jump', [-HOUR, HOUR], ids=['back', 'forward'])
def test_a_clock_that_jumps_stops_nobody_and_changes_no_weight(jump, set_clock, make_graph, tmp_path):
    graph = make_graph(tmp_path / 'graph', SMALL)
    heard: dict[str, list[int]] = {f'/{name}': [] for name in graph.names}

    def hear(report: DiagnosticArray) -> None:
        for status in report.status:
            heard[status.name].append(report.header.stamp.sec)

    graph.start(*graph.names)
    with Listener() as listener:
        listener.wait_for_status(lambda status: status.policy_version >= 1)
        listener.call(Trigger, names.PAUSE, Trigger.Request())
        listener.node.create_subscription(DiagnosticArray, names.DIAGNOSTICS, hear, qos.EVENTS)
        listener.spin_until(lambda: all(heard.values()))
        set_clock(jump)
        before = {name: stamps[-1] for name, stamps in heard.items()}
        listener.spin_until(lambda: all(sum(abs(stamp - before[name] - jump) < HOUR / 2 for stamp in stamps) >= 3
                                        for name, stamps in heard.items()), lambda: f'who is silent since? {heard}')
        listener.call(Trigger, names.RESUME, Trigger.Request())
    assert graph.wait() == 0, graph.log('trainer')
    assert graph.result() == oracle(tmp_path / 'alone', SMALL)
