"""What the robot is: joints, limits, frames, collision geometry, and the policy's interface."""
