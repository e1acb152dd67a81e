"""Control of force and position: the tick loop, the force servo and the approach. These modules
talk to no instrument: the procedures do, with what is computed here."""
