"""The executables. Each module declares, wires and delegates; what is computed lies in `dae_ros`.

Importing this package sets how many threads numerical libraries start, before any of them is imported: several nodes
share the cores, and a library's idle threads spin on a core that another node needs.
"""

import os

for variable in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
    os.environ.setdefault(variable, '1')
os.environ.setdefault('OMP_WAIT_POLICY', 'PASSIVE')
