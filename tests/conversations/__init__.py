"""Conversations of one component with a simulated vehicle, in virtual time on trio and asyncio."""
