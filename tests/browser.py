"""A headless Chromium, driven by its DevTools protocol: for tests of pages."""

import base64
import io
import json
import pathlib
import shutil
import subprocess
import time
import urllib.request

import numpy as np

__all__ = ["Browser", "executable"]


def executable():
    """Path of a Chromium or Chrome, or None."""
    return next(
        filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None
    )


class Browser:
    """One page of `size` pixels; WebGL is rendered by the CPU. A context manager."""

    def __init__(self, url, profile, size=(1000, 700)):
        from websockets.sync.client import connect

        self._log = open(pathlib.Path(profile) / "chromium.log", "w")
        flags = [
            *(
                "--headless=new",
                "--no-sandbox",
                "--no-first-run",
                "--disable-extensions",
                "--disable-background-networking",
            ),
            *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--remote-debugging-port=0"),
            f"--window-size={size[0]},{size[1]}",
            f"--user-data-dir={profile}",
        ]
        self._process = subprocess.Popen([executable(), *flags, url], stdout=self._log, stderr=self._log)
        try:
            port = int(
                self._wait(
                    lambda: (pathlib.Path(profile) / "DevToolsActivePort").read_text().split("\n")[0], 30
                )
            )
            page = self._wait(lambda: next(p for p in self._pages(port) if p["type"] == "page"), 30)
            self._socket, self._count = connect(page["webSocketDebuggerUrl"], max_size=None), 0
        except BaseException:
            self.close()
            raise

    @staticmethod
    def _pages(port):
        return json.load(urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=5))

    @staticmethod
    def _wait(what, seconds):
        """what(), called again until it raises nothing or the time is over."""
        end = time.monotonic() + seconds
        while True:
            try:
                return what()
            except (OSError, StopIteration, ValueError, AssertionError):
                if time.monotonic() > end:
                    raise
                time.sleep(0.2)

    def command(self, method, **params):
        """Result of a DevTools command."""
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": params}))
        while True:
            answer = json.loads(self._socket.recv(timeout=300))
            if answer.get("id") == self._count:
                return answer["result"]

    def evaluate(self, script):
        """Value of a JavaScript expression in the page."""
        return self.command("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def click(self, element, share=0.5):
        """Presses and releases the mouse on what a JavaScript expression says, `share` of its width from its
        left."""
        box = self.evaluate(f"(({element}).getBoundingClientRect()).toJSON()")
        place = dict(x=box["x"] + share * box["width"], y=box["y"] + box["height"] / 2)
        for kind in ("mousePressed", "mouseReleased"):
            self.command("Input.dispatchMouseEvent", type=kind, button="left", clickCount=1, **place)

    def picture(self):
        """(height, width, 3) uint8: what the page looks like."""
        from PIL import Image

        data = base64.b64decode(self.command("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def until(self, holds, seconds=300):
        """The first picture for which holds(picture) is true.

        Raises:
          AssertionError: there was none for so long.
        """

        def look():
            picture = self.picture()
            assert holds(picture), f"the page did not come to look as expected within {seconds} s"
            return picture

        return self._wait(look, seconds)

    def close(self):
        self._process.terminate()
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
        self._log.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()
