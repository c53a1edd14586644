"""Heads to learn from: people of MakeHuman (CC0), scanned identities of ICT-FaceKit (MIT), meshes of one's own."""

from facerelight.bootstrap.heads.head import Head, HeadSource
from facerelight.bootstrap.heads.identities import IctHeads
from facerelight.bootstrap.heads.makehuman import MakeHumanHeads

__all__ = ["Head", "HeadSource", "IctHeads", "MakeHumanHeads"]
