"""Settings of the whole suite."""

import os

# torch's threads must sleep, not spin, while they wait: on shared cores spinning costs up to five times the run time
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from tests.battery.pretend_device import register

register()
