"""Settings of the whole suite."""

import os
import signal
import threading

# torch's threads must sleep, not spin, while they wait: on shared cores spinning costs up to five times the run time
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# what is tested must not hang on model files that somebody has fetched: tests of real videos find them by themselves
os.environ["DYNTORCH_POSE_MODELS"] = os.path.join(os.path.dirname(__file__), "no-models")

# a shell that starts the suite in the background has Ctrl-C ignored, here and in what is started from here
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)

from tests.battery.pretend_device import register

pytest_plugins = ["tests.tiers"]

register()
