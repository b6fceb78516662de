"""Speed against error of a document's sensors and physics, on states of its scene."""
