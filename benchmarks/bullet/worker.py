"""A process of simulations: python -m bullet.worker DESCRIPTOR, of the pipe that says what to do."""

import sys
from multiprocessing.connection import Connection

from .herd import serve

if __name__ == "__main__":
    serve(Connection(int(sys.argv[1])))
