"""The devices from the other side: an emulated laser and receiver, and the world that they see.

Written from the protocol sheets alone and sharing nothing with the drivers, so that the two readings of
one protocol check each other.
"""
