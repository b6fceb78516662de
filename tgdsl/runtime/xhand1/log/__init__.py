"""Logs of the XHand1: recording and replay."""
