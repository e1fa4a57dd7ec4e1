"""Ctrl-C: it ends a command, but not between the start of a process and the note of it."""

import subprocess
import sys

PROGRAM = '''
import os, signal
from dae_ros.command import interrupt_once, run_command, uninterrupted

def act():
    with uninterrupted():
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000):
            pass  # Python would raise here
        print('noted')
    print('never reached')

signal.signal(signal.SIGINT, signal.default_int_handler)
interrupt_once()
raise SystemExit(run_command(act, 'stopped'))
'''


def test_an_interrupt_is_put_off_to_the_end_of_what_must_not_be_interrupted():
    done = subprocess.run([sys.executable, '-c', PROGRAM], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (130, 'noted\n', 'stopped\n')
