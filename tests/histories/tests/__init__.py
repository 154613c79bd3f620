"""Tests of the checkers: each finds what it is for."""
