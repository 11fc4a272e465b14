"""Refusals of the sockets: their counts for `health` and the log, and the allowed rate."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import structlog


def is_logged(count: int) -> bool:
    """Return whether the event of this number is logged, of those that are frequent: 1, 10, 100 and so on."""
    return str(count).strip("0") == "1"


@dataclass(frozen=True, slots=True)
class Refusals:
    """Numbers of refused requests and clients, by kind."""

    counts: Counter[str] = field(default_factory=Counter)

    def add(self, kind: str, reason: str, *, frequent: bool = False) -> None:
        """Count and log a refusal; a frequent kind is logged at counts 1, 10, 100 and so on."""
        self.counts[kind] += 1
        count = self.counts[kind]
        if not frequent or is_logged(count):
            structlog.get_logger().warning("refused", what=kind.removesuffix(" refused"), reason=reason, count=count)

    def diagnostics(self) -> Mapping[str, Mapping[str, int]]:
        """Return the counts for `health`."""
        return {"errors": dict(self.counts)}


@dataclass(slots=True)
class TokenBucket:
    """Allows `burst` requests at once and `per_s` requests per second on average."""

    burst: float
    per_s: float
    used: float = 0.0
    updated_ns: int = 0

    def has_token(self, t_ns: int) -> bool:
        """Return whether a token is left at monotonic time t_ns."""
        self.used = max(0.0, self.used - self.per_s * (t_ns - self.updated_ns) / 1e9)
        self.updated_ns = t_ns
        return self.used <= self.burst - 1.0

    def allow(self, t_ns: int) -> bool:
        """Use one token at monotonic time t_ns; return False if no token is left."""
        allowed = self.has_token(t_ns)
        self.used += allowed
        return allowed
