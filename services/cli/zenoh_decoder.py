"""The decoder that ``zenoh --decoder treedock`` loads (entry point group zenoh_cli.codecs.decoders of zenoh-cli 0.7).

zenoh-cli must be told to be a client of our router: ``zenoh --mode client --connect tcp/127.0.0.1:7447 subscribe
-k 'treedock/v1/**' --decoder treedock``.
"""

from __future__ import annotations


def decode(key: str, value: bytes) -> str:
    """Return the sample as one line of JSON; never raises for bytes that are not ours, but says so."""
    from services.cli.readable import text

    return text(key, value)
