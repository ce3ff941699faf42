"""The decoder that ``zenoh --decoder treedock`` loads (entry point group zenoh_cli.codecs.decoders of zenoh-cli 0.7).

zenoh-cli must be told to be a client of our router: ``zenoh --mode client --connect tcp/127.0.0.1:7447 subscribe
-k 'treedock/v1/**' --decoder treedock``.
"""

from __future__ import annotations


def decode(key: object, value: bytes) -> str:
    """Return the sample as one line of JSON; never raises for bytes that are not ours, but says so.

    zenoh-cli's own decoders are annotated for a key of type str; what 0.7 passes is Zenoh's KeyExpr.
    """
    from services.cli.readable import text

    return text(str(key), value)
