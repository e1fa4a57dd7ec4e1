"""By what Fast DDS carries messages: UDP alone, also on one host, unless who starts a process says otherwise.

Its own default adds shared memory, which a killed process leaves in whatever state it is in: locked, or half made. Others then
wait for it without an end, or never hear of somebody, and half a MiB of it stays behind. UDP takes no more time.
"""

from __future__ import annotations

import os

VARIABLE = 'FASTDDS_BUILTIN_TRANSPORTS'
UDP = 'UDPv4?sockets_size=4MB'  # room for a burst of many robots, as far as the kernel's net.core.rmem_max lets it


def choose() -> None:
    """Sets it for this process, before it joins DDS, and for those it starts."""
    os.environ.setdefault(VARIABLE, UDP)
