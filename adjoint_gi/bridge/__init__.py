"""Everything that touches Blender's data: reading scenes, writing results, jobs, engine and command line."""
