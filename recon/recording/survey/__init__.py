"""What a recorded stack tells of its lamp, its camera and its prisms, before anything is fitted."""
