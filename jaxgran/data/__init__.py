"""Cooling curves and their files, particles and their files, checkpoints, and options of a run.

- `curve`: `CoolingCurve`; `quantities` lists its quantities, `curve_checks` checks their values,
  `curve_arrays` names its arrays. `particles`: positions and velocities; `run_options`: options of
  the run of a model.
- `measurement`: a measured curve or `drop_test`, with its gas and what is known of both.
- `measurement_file`, `curve_file`: files of any format. `curve_archive` reads and writes npz files,
  `tables` reads CSV tables, `drop_test_file` those of drop tests, `definitions` says what a column
  may hold in place of T.
- `header`: the gas that the header of a file describes, with `header_elements`, and
  `measurement_header` the rest. `header_keys` lists the keys; `header_lines`, `header_values`,
  `units` and `written_numbers` read their values.
- `usual_values`, `curve_questions`: questions about unusual data, which name the value, what is
  usual, and what would make it usual. The readers warn by them, and use the values as they are.
- `tracks`: T(t) from positions in frames (`track_positions`, `displacements`, `velocity_memory`).
- `track_impacts`: impacts from tracks, in the steps `motion`, `encounters`, `flights`, `contacts`.
- `particle_file` reads files of particles, frame by frame (`particle_frame`), and
  `trajectory_curve` T(t) from them; `trajectory` writes them.
- `checkpoint`: the state of a run in a file. `scene_file`: TOML files of a scene. `lammps`: input
  for LAMMPS. `example`: the measurement that comes with the package. `files`: reading and writing.

The package imports `jaxgran._utils` and `jaxgran.scene` only; every package above may import it.
"""
