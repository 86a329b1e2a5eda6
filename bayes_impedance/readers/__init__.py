"""Readers: one file a format, one function for all of them."""

from bayes_impedance.readers.read import read_log as read_log
