"""Environments played: by given, random, scripted or learned actions; what happened is shown, written and drawn."""
