"""How many requests a client may make: a bucket of tokens each, and one for all together. Time is passed in."""

from collections import OrderedDict

# A person, a script and a page that polls stay far below these; one that loops without a pause does not.
PER_CLIENT_BURST, PER_CLIENT_PER_S = 20.0, 10.0
ALL_BURST, ALL_PER_S = 100.0, 50.0
# Clients remembered at once: one that reconnects to be forgotten still meets the bucket of all.
MOST_CLIENTS = 256


class TokenBucket:
    """`burst` requests at once, and `per_s` in the long run."""

    def __init__(self, burst: float, per_s: float) -> None:
        self._burst = burst
        self._per_s = per_s
        self._tokens = burst
        self._at_ns: int | None = None

    def take(self, t_ns: int) -> bool:
        """Return whether one more is allowed at this moment (monotonic), and count it if it is."""
        if self._at_ns is not None:
            self._tokens = min(self._burst, self._tokens + self._per_s * max(0, t_ns - self._at_ns) / 1e9)
        self._at_ns = t_ns
        if self._tokens < 1.0:
            return False
        self._tokens -= 1.0
        return True


class RateLimit:
    """Which of many clients' requests are too many."""

    def __init__(self) -> None:
        self._all = TokenBucket(ALL_BURST, ALL_PER_S)
        self._each: OrderedDict[bytes, TokenBucket] = OrderedDict()

    def allows(self, client: bytes, t_ns: int) -> bool:
        """Return whether a client may make one more request at this moment (monotonic).

        A client that is over its own limit does not use up what is left for the others.
        """
        bucket = self._each.get(client)
        if bucket is None:
            bucket = self._each[client] = TokenBucket(PER_CLIENT_BURST, PER_CLIENT_PER_S)
            if len(self._each) > MOST_CLIENTS:
                self._each.popitem(last=False)
        self._each.move_to_end(client)
        return bucket.take(t_ns) and self._all.take(t_ns)
