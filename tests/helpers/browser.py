"""A headless Chromium that is driven over a pipe, by its own DevTools protocol."""

import atexit
import base64
import contextlib
import functools
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time

NAMES = "chromium", "chromium-browser", "google-chrome", "chrome"
BROWSER = next(filter(None, map(shutil.which, NAMES)), None)
OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--remote-debugging-pipe",
    "about:blank",
)
# Chromium reads from 3 and writes to 4, whatever numbers the pipe's ends have here.
WRAPPER = """
import fcntl, os, sys
ends = [fcntl.fcntl(int(n), fcntl.F_DUPFD, 10) for n in sys.argv[1:3]]
os.dup2(ends[0], 3)
os.dup2(ends[1], 4)
os.execv(sys.argv[3], sys.argv[3:])
"""
PATIENCE_S = 60.0  # for one answer: machines that run other tests beside are slow


class _Chromium:
    """The one browser of this process, with a session for each page; it ends as its pipe does.

    pages: {session: Browser}
    """

    def __init__(self):
        (theirs_in, self.out), (self.into, theirs_out) = os.pipe(), os.pipe()
        self.folder = tempfile.TemporaryDirectory(prefix="browser-", ignore_cleanup_errors=True)
        words = [BROWSER, f"--user-data-dir={self.folder.name}", *OPTIONS]
        self.process = subprocess.Popen(
            [sys.executable, "-c", WRAPPER, str(theirs_in), str(theirs_out), *words],
            pass_fds=(theirs_in, theirs_out),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self.buffer, self.number, self.pages = b"", 0, {}
        atexit.register(self.close)

    def close(self):
        with contextlib.suppress(OSError, AssertionError):
            self.ask("Browser.close")
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(10)
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        os.close(self.out)
        os.close(self.into)

    def ask(self, method, session=None, **parameters):
        """The answer to a request; what pages say meanwhile is noted by them."""
        self.number += 1
        request = {"id": self.number, "method": method, "params": parameters}
        if session:
            request["sessionId"] = session
        os.write(self.out, json.dumps(request).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self.number:
                assert "error" not in answer, (method, answer["error"])
                return answer["result"]
            if page := self.pages.get(answer.get("sessionId")):
                page.note(answer)

    def _next(self):
        end = time.monotonic() + PATIENCE_S
        while b"\0" not in self.buffer:
            ready, _, _ = select.select([self.into], [], [], max(0, end - time.monotonic()))
            assert ready, "the browser does not answer"
            piece = os.read(self.into, 1 << 16)
            assert piece, "the browser has ended"
            self.buffer += piece
        text, _, self.buffer = self.buffer.partition(b"\0")
        return json.loads(text)


@functools.cache
def _chromium():
    return _Chromium()


class Browser:
    """One page with a profile of its own; a context manager.

    size: of the window [px]; dark: which colours the user likes
    messages: errors and warnings of the console, and requests that left the machine
    """

    def __init__(self, *, size=(1400, 1000), dark=False, script=True):
        self.chromium, self.session, self.messages = _chromium(), None, []
        self.profile = self.ask("Target.createBrowserContext")["browserContextId"]
        own = {"browserContextId": self.profile}
        target = self.ask("Target.createTarget", url="about:blank", **own)["targetId"]
        self.session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.chromium.pages[self.session] = self
        for room in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{room}.enable")
        width, height = size
        self.ask(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        likes = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.ask("Emulation.setEmulatedMedia", features=likes)
        if not script:
            self.ask("Emulation.setScriptExecutionDisabled", value=True)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        del self.chromium.pages[self.session]
        with contextlib.suppress(OSError, AssertionError):
            self.chromium.ask("Target.disposeBrowserContext", browserContextId=self.profile)

    def ask(self, method, **parameters):
        """The answer to a request."""
        return self.chromium.ask(method, self.session, **parameters)

    def note(self, event):
        """Keeps what a page should never do."""
        given = event.get("params", {})
        match event.get("method"):
            case "Runtime.exceptionThrown":
                self.messages.append(str(given["exceptionDetails"]))
            case "Log.entryAdded" if given["entry"]["level"] in ("error", "warning"):
                self.messages.append(given["entry"]["text"])
            case "Runtime.consoleAPICalled" if given["type"] in ("error", "warning"):
                self.messages.append(str(given["args"]))
            case "Network.requestWillBeSent":
                url = given["request"]["url"]
                if not url.startswith(("file:", "data:", "about:")):
                    self.messages.append(f"asks for {url}")

    def save_into(self, folder):
        """Lets the page save files there."""
        where = {"behavior": "allow", "downloadPath": str(folder)}
        self.ask("Browser.setDownloadBehavior", browserContextId=self.profile, **where)

    def open(self, path, anchor=""):
        """Shows a file, and waits until all of it is there."""
        self.ask("Page.navigate", url=f"{path.absolute().as_uri()}{anchor}")
        self.until("document.readyState === 'complete' && location.protocol === 'file:'")

    def value(self, expression):
        """Value of an expression in the page, or of its promise."""
        how = {"returnByValue": True, "awaitPromise": True}
        answer = self.ask("Runtime.evaluate", expression=expression, **how)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def until(self, expression):
        """Waits until an expression is true in the page; its value."""
        end = time.monotonic() + PATIENCE_S
        while not (found := self.value(expression)):
            assert time.monotonic() < end, f"{expression} stays {found!r}"
            time.sleep(0.05)
        return found

    def click(self, x, y):
        """Press and release the mouse."""
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x, y, button="left", clickCount=1)

    def mouse(self, kind, x, y, **more):
        """One event of the mouse, at a place of the window."""
        self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def key(self, key, text=""):
        """Press and release a key."""
        more = {"text": text} if text else {}
        for kind in ("keyDown", "keyUp"):
            self.ask("Input.dispatchKeyEvent", type=kind, key=key, **(more if text else {}))

    def picture(self):
        """The window as the bytes of a PNG."""
        return base64.b64decode(self.ask("Page.captureScreenshot", format="png")["data"])
