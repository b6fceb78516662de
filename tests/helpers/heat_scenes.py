"""Boxes that touch as a test says: a module of temperatures, and states with contacts that are made up."""

from tgdsl.report.oracles.setups.boxes import begin, cells_of, face_contacts, heat_module, heat_state

__all__ = ["begin", "cells_of", "face_contacts", "heat_module", "heat_state"]
