"""How a node takes part in ROS 2: domain, interface, names of topics and their quality of service."""

from __future__ import annotations

import ipaddress
import os
import re
from dataclasses import dataclass

from mvsgs_core.named_modules import is_installed

LOOPBACK, ANY = "lo", "auto"
LAST_DOMAIN = 232  # beyond it there are no ports
_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
_INTERFACE = re.compile(r"[A-Za-z0-9_.:@-]{1,64}")


class DdsError(RuntimeError):
    """DDS cannot do it; the message says what to change."""


@dataclass(kw_only=True)
class Connection:
    """Where other programs of ROS 2 are found. Nothing beyond this machine sends or gets anything unless it is named.

    Raises ValueError for a domain, an interface or a namespace that is none.
    """

    # lo: programs on this machine, which are to be started with ROS_LOCALHOST_ONLY=1; auto: the network, as ROS 2 does,
    # with $CYCLONEDDS_URI; else the name or the address of an interface
    interface: str = LOOPBACK
    domain: int | None = None  # null: $ROS_DOMAIN_ID, or 0
    namespace: str = ""  # before names of topics that do not begin with /

    def __post_init__(self) -> None:
        number = self.number
        if not 0 <= number <= LAST_DOMAIN:
            raise ValueError(f"domain={number}: ROS 2's domains are 0 to {LAST_DOMAIN}")
        if not _INTERFACE.fullmatch(self.interface):
            raise ValueError(f"interface={self.interface!r}: must be lo, auto, or an interface's name or address")
        if self.namespace:
            self.topic("topic")

    @property
    def number(self) -> int:
        """The domain. Raises ValueError where the environment says none."""
        if self.domain is not None:
            return self.domain
        said = os.environ.get("ROS_DOMAIN_ID") or "0"
        if not said.isdecimal():
            raise ValueError(f"ROS_DOMAIN_ID={said!r} is no number; set domain")
        return int(said)

    def topic(self, name: str) -> str:
        """The full name of a topic. Raises ValueError for what is no name in ROS 2."""
        full = name if name.startswith("/") else f"/{self.namespace.strip('/')}/{name}".replace("//", "/")
        if not _NAME.fullmatch(full):
            raise ValueError(f"{full!r} is no name of a topic: words of letters, digits and _ with / between them")
        return full

    @property
    def xml(self) -> str:
        """Cyclone DDS's configuration."""
        if self.interface == LOOPBACK:
            where = 'address="127.0.0.1"'
        else:
            where = f'{"address" if _is_address(self.interface) else "name"}="{self.interface}"'
        interface = f"<General><Interfaces><NetworkInterface {where}/></Interfaces></General>"
        if self.interface == ANY:  # Cyclone chooses; one of ours would be added to those of $CYCLONEDDS_URI
            interface = ""
        # beyond the limit a stranger's sample would fill the memory; where this process waits for its turn, images of
        # some time wait in the kernel, as many as it lets (net.core.rmem_max)
        internal = (
            f'<MaxSampleSize>{MAX_SAMPLE_BYTES} B</MaxSampleSize><SocketReceiveBufferSize max="{SOCKET_BUFFER}"/>'
        )
        ours = f"<CycloneDDS><Domain>{interface}<Internal>{internal}</Internal></Domain></CycloneDDS>"
        theirs = os.environ.get("CYCLONEDDS_URI", "") if self.interface == ANY else ""
        return ours + (f",{theirs}" if theirs else "")


MAX_SAMPLE_BYTES = 2**28 + 2**21  # of a message, as in bags
SOCKET_BUFFER = "16 MB"


@dataclass(frozen=True)
class Quality:
    """Quality of service. The last `depth` messages are kept, for late readers too where it is `transient_local`."""

    reliable: bool
    depth: int
    transient_local: bool = False


# ROS 2's own (rmw/qos_profiles.h, tf2_ros/qos.hpp, REP 2003)
SENSOR_DATA = Quality(reliable=False, depth=5)
DEFAULT = Quality(reliable=True, depth=10)
LATCHED = Quality(reliable=True, depth=1, transient_local=True)
TF = Quality(reliable=True, depth=100)


def check_installed() -> None:
    """Raises ValueError, saying what to do, where there is no DDS."""
    if not is_installed("cyclonedds"):
        raise ValueError("ROS 2 is reached by cyclonedds, which is optional: pip install cyclonedds")


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True
