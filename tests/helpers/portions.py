"""Work for processes of several devices; a module, since they must import it."""

import os
import time


def squares(items, device):
    """Squares, with the process that made them."""
    return [(item * item, os.getpid()) for item in items]


def fails_on_seven(items, device):
    if 7 in items:
        raise ArithmeticError("seven")
    return squares(items, device)


def first_dies(items, device):
    """The first process of all to come here dies; a file in the folder that is named tells."""
    folder = items[0][0]
    try:
        os.close(os.open(os.path.join(folder, "first"), os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return [number for _, number in items]
    os._exit(3)


def slow(items, device):
    time.sleep(0.02 * len(items))
    return items
