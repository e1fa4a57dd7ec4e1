"""Nodes leave DDS without waiting for ever.

Before a process leaves, Fast DDS stops listening to who comes and goes, and waits for the call under way. Where it is built for
an old libstdc++, as in the wheels, that wait, which has no limit, is a loop that holds the lock the call needs to end (Fast DDS
issue 6513): of processes that leave together one may never end. The same wait with a limit is sound, and after it none is left.
"""

from __future__ import annotations

import ctypes
from typing import Sequence

from rclpy.node import Node
from rclpy.utilities import get_rmw_implementation_identifier

PATIENCE = 10  # s; a call takes a millisecond
FAST_DDS = 'rmw_fastrtps_cpp'
PARTICIPANT = '_ZN16rmw_fastrtps_cpp22get_domain_participantEP10rmw_node_s'
SET_LISTENER = ('_ZN8eprosima7fastdds3dds17DomainParticipant12set_listenerEPNS1_25DomainParticipantListenerE'
                'NSt6chrono8durationIlSt5ratioILl1ELl1EEEE')


def leave(nodes: Sequence[Node]) -> None:
    """Destroys nodes, all that there are of a context."""
    if nodes and get_rmw_implementation_identifier() == FAST_DDS:
        _stop_listening(nodes[0])
    for node in nodes:
        node.destroy_node()


def _stop_listening(node: Node) -> None:
    """The nodes of this node's context hear no more of who comes and goes."""
    try:
        rcl, rmw = ctypes.CDLL('librcl.so'), ctypes.CDLL(f'lib{FAST_DDS}.so')
        rmw_node_of = rcl.rcl_node_get_rmw_handle
        participant_of, set_listener = getattr(rmw, PARTICIPANT), getattr(rmw, SET_LISTENER)
    except (OSError, AttributeError):  # those of another version, of which this is not known
        return
    for find in rmw_node_of, participant_of:
        find.argtypes, find.restype = [ctypes.c_void_p], ctypes.c_void_p
    set_listener.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64]
    with node.handle:
        participant = participant_of(rmw_node_of(node.handle.pointer))
        if participant is not None:
            set_listener(participant, None, PATIENCE)
