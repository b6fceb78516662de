"""Calibration of a real hand, fitted to logs under known forces."""
