"""Runs the page's server beside its subscription until a signal ends both."""

import asyncio
from collections.abc import Callable

import zmq.asyncio
from aiohttp import web

from shearloop.bank.eit.fingertip import Fingertip
from shearloop.daemon.ending_signals import ending_signals
from shearloop.daemon.errors import UserError
from shearloop.daemon.web.bridge import Bridge, Place
from shearloop.daemon.web.conductivity import outline
from shearloop.daemon.web.latest import Latest
from shearloop.daemon.web.server import make_app

HOST = "127.0.0.1"
# What is under way at the end has so long.
SHUTDOWN_S = 1.0


async def serve(place: Place, port: int, token: str, fingertip: Fingertip, ready: Callable[[int], None]) -> None:
    """Serve the page on loopback, call `ready` with its port, and return after SIGINT, SIGTERM or SIGHUP.

    Raises UserError for a port that is taken and for a malformed address.
    """
    loop = asyncio.get_running_loop()
    ending, ended = ending_signals(), asyncio.Event()
    with zmq.asyncio.Context() as context:
        bridge = Bridge(context, place, Latest(fingertip.height_cm))
        runner = web.AppRunner(
            make_app(bridge, token, outline(fingertip), place.publish), access_log=None, shutdown_timeout=SHUTDOWN_S
        )
        reading = asyncio.create_task(bridge.run(), name="messages")
        try:
            await runner.setup()
            site = web.TCPSite(runner, HOST, port)
            try:
                await site.start()
            except OSError as error:
                raise UserError(
                    f"the page cannot be served on {HOST}:{port} ({error.strerror}); give another --port"
                ) from error
            for number in ending:
                loop.add_signal_handler(number, ended.set)
            ready(runner.addresses[0][1])
            waiting = asyncio.create_task(ended.wait())
            # A subscription that died would leave a page that looks at nothing: it ends the view.
            await asyncio.wait((waiting, reading), return_when=asyncio.FIRST_COMPLETED)
            waiting.cancel()
            await asyncio.gather(waiting, return_exceptions=True)
            if reading.done():
                reading.result()
        finally:
            for number in ending:
                loop.remove_signal_handler(number)
            reading.cancel()
            await asyncio.gather(reading, return_exceptions=True)
            await runner.cleanup()
            bridge.close()
