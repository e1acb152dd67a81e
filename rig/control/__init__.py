"""Control of force and position: the tick loop, the force servo, the approach. No instruments."""
