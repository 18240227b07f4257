"""Simulated faults: injected into recordings, or into a circuit model of the array, where
adaptfault-bench is installed."""

from pkgutil import extend_path

__path__ = extend_path(__path__, __name__)
