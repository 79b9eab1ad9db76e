"""Measurements of a device kept for later runs: tuned sizes, self-test.

The user's cache folder, or the folder named by CLRESAMPLE_CACHE, has one JSON file for each device,
driver and version of clresample. The files may be deleted: the measurements are then repeated.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import warnings
from contextlib import suppress
from pathlib import Path

from .. import __version__


class DeviceWarning(UserWarning):
    """A message about a device for the user, in one line."""


def cache_folder():
    """Folder of files that can be made again: CLRESAMPLE_CACHE, or the system's cache."""
    given = os.environ.get("CLRESAMPLE_CACHE")
    return Path(given) if given else system_caches() / "clresample"


def system_caches():
    """The system's folder for the user's caches."""
    import platformdirs  # for commands that need no device

    return platformdirs.user_cache_path()


class DeviceCache:
    """The JSON file of one device, in named parts.

    cl_device: the pyopencl device; each driver and version of clresample has a file of its own
    """

    def __init__(self, cl_device):
        self.about = {
            "platform": cl_device.platform.name.strip(),
            "device": cl_device.name.strip(),
            "driver": f"{cl_device.platform.version} {cl_device.driver_version}".strip(),
            "clresample": __version__,
        }
        key = hashlib.sha256(json.dumps(self.about).encode()).hexdigest()[:16]
        self._content = None
        self.path = cache_folder() / "devices" / f"{key}.json"

    def read(self, part):
        """A stored part, or None. A file that cannot be read is ignored, with a warning."""
        return self._all().get(part)

    def write(self, part, content):
        """Stores a part beside the others. Raises OSError if the file cannot be written."""
        everything = self.about | self._all() | {part: content}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=self.path.parent, prefix=f"{self.path.stem}-")
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                json.dump(everything, file, indent=1)
            os.replace(name, self.path)
        except BaseException:
            with suppress(OSError):
                os.unlink(name)
            raise
        self._content = everything

    def override(self, part, content):
        """Overrides a part for the rest of this process; the file is unchanged."""
        self._all()[part] = content

    def invalidate(self, part, why):
        """Ignores a part for the rest of this process, with a warning; the file is unchanged."""
        if self._all().pop(part, None) is not None:
            self.warn_ignored(why)

    def warn_ignored(self, why):
        """Warns, in one line, that the file's content is not used."""
        warnings.warn(f"{self.path} is ignored: {why}", DeviceWarning, stacklevel=2)

    def _all(self):
        """The file's content, read once."""
        if self._content is None:
            self._content = self._read()
        return self._content

    def _read(self):
        try:
            content = json.loads(self.path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        except (OSError, ValueError) as error:
            self.warn_ignored(" ".join(str(error).split()))
            return {}
        if not isinstance(content, dict):
            self.warn_ignored("it holds no JSON object")
            return {}
        return content
