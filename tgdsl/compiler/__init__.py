"""The compiler: from a document and a robot to a Plan."""
