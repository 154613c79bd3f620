"""Tests of the edge client."""
