"""Two hosts and the cable between them: network namespaces, two veth pairs, and a process that forwards what it likes.

Run as a program it is that process, in a namespace of its own: it takes a `Weather` as JSON on each line of its input. The
kernel's netem would do the same but is not everywhere.
"""

from __future__ import annotations

import dataclasses
import heapq
import json
import random
import select
import socket
import subprocess
import sys
import time
from dataclasses import dataclass

SOL_PACKET, PACKET_VNET_HDR, PACKET_IGNORE_OUTGOING, ETH_P_ALL = 263, 15, 23, 3
VIRTIO_HEADER = 10  # bytes before each frame
LONGEST_FRAME = 70_000  # bytes, several in one before the kernel splits them
LONGEST_QUEUE = 1.0  # s; what would wait longer for its turn is lost
ADDRESSES = '10.77.0.1', '10.77.0.2'


@dataclass(frozen=True)
class Weather:
    """What becomes of the frames on the cable, in each direction."""

    loss: float = 0.0     # share that is lost
    delay: float = 0.0    # s
    reorder: float = 0.0  # share that overtakes the others: no delay
    rate: float = 1e9     # bit/s
    multicast: bool = True


class Host:
    """A namespace with a network card, and shared memory of its own, so that DDS takes no short cut; as long as its process."""

    def __init__(self, address: str):
        self.address = address
        hold = 'mount -t tmpfs shm /dev/shm && ip link set lo up && echo up && exec cat'
        self._process = subprocess.Popen(['unshare', '--mount', '--net', 'sh', '-c', hold], stdin=subprocess.PIPE,
                                         stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        if self._process.stdout.readline() != 'up\n':
            raise OSError(f'no network namespaces here: {self.close()}')
        self.pid = self._process.pid
        self.prefix = ['nsenter', f'--mount=/proc/{self.pid}/ns/mnt', f'--net=/proc/{self.pid}/ns/net', '--wdns=.', '--']

    def close(self) -> str:
        self._process.kill()
        return self._process.communicate()[1].strip()


class Link:
    """Two hosts with a cable between them. A context manager; OSError where this is not allowed."""

    def __init__(self):
        self.hosts: list[Host] = []
        self._cable: subprocess.Popen | None = None

    def __enter__(self) -> Link:
        try:
            self.hosts += [Host(address) for address in ADDRESSES]
            command = ['unshare', '--net', sys.executable, __file__, *(str(host.pid) for host in self.hosts)]
            self._cable = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                                           text=True)
            if self._cable.stdout.readline() != 'up\n':
                raise OSError(f'no cable can be made here: {self._cable.communicate()[1].strip()[-300:]}')
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_) -> None:
        if self._cable is not None:
            self._cable.kill()
            self._cable.communicate()
        for host in self.hosts:
            host.close()

    def change(self, weather: Weather) -> None:
        """From here on the cable is like this."""
        self._cable.stdin.write(json.dumps(dataclasses.asdict(weather)) + '\n')
        self._cable.stdin.flush()
        assert self._cable.stdout.readline() == 'changed\n'


CLEAR, CUT = Weather(), Weather(loss=1.0)


def attach(host: str, card: str, address: str) -> socket.socket:
    """Makes a veth pair from here to the host; a socket that hears what the host sends, and sends what it is to hear."""
    def ip(*arguments: str, there: bool = False) -> None:
        subprocess.run([*(('nsenter', f'--net=/proc/{host}/ns/net', '--') if there else ()), 'ip', *arguments], check=True)

    ip('link', 'add', card, 'type', 'veth', 'peer', 'name', 'eth0', 'netns', host)
    ip('link', 'set', card, 'up')
    ip('addr', 'add', f'{address}/24', 'dev', 'eth0', there=True)
    ip('link', 'set', 'eth0', 'up', there=True)
    ip('route', 'add', '224.0.0.0/4', 'dev', 'eth0', there=True)
    end = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETH_P_ALL))
    end.setsockopt(SOL_PACKET, PACKET_VNET_HDR, 1)  # keeps what the kernel left for hardware to do, such as checksums
    end.setsockopt(SOL_PACKET, PACKET_IGNORE_OUTGOING, 1)
    end.bind((card, 0))
    return end


def forward(hosts: list[str]) -> None:
    """Forwards frames between the hosts until it is killed."""
    draw, weather = random.Random(1), CLEAR
    ends = [attach(host, f'card{number}', address) for number, (host, address) in enumerate(zip(hosts, ADDRESSES))]
    others = dict(zip(ends, reversed(ends)))
    free_at = dict.fromkeys(ends, 0.0)  # when the cable has said what it was given
    under_way: list[tuple[float, int, socket.socket, bytes]] = []
    count = 0
    print('up', flush=True)
    while True:
        wait = max(0.0, under_way[0][0] - time.monotonic()) if under_way else None
        ready, _, _ = select.select([*ends, sys.stdin], [], [], wait)
        now = time.monotonic()
        while under_way and under_way[0][0] <= now:
            _, _, end, frame = heapq.heappop(under_way)
            try:
                end.send(frame)
            except OSError:
                pass  # the card is full: lost
        for end in ready:
            if end is sys.stdin:
                line = sys.stdin.readline()
                if not line:
                    return
                weather = Weather(**json.loads(line))
                print('changed', flush=True)
                continue
            frame = end.recv(LONGEST_FRAME)
            begin = max(now, free_at[end])
            multicast = frame[VIRTIO_HEADER:].startswith(b'\x01\x00\x5e')
            if draw.random() < weather.loss or begin - now > LONGEST_QUEUE or multicast and not weather.multicast:
                continue
            free_at[end] = begin + 8 * len(frame) / weather.rate
            delay = 0.0 if draw.random() < weather.reorder else weather.delay
            count += 1
            heapq.heappush(under_way, (free_at[end] + delay, count, others[end], frame))


if __name__ == '__main__':
    forward(sys.argv[1:])
