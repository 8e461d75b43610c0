"""The arrays that the fused kernel works on, bundled so that a launch takes a handful of arguments.

Worlds with the same topology share one thread in groups of L. Arrays of V or V3 are indexed by
group, arrays of scalars by world (``group * L + lane``; the last group is padded with worlds that
never run). Indices inside a topology are local to its world.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from .adjoint_structures import adjoint_structures
from .algebra import lane_types

__all__ = ["structures"]


@functools.cache
def structures(scalar: Any, lanes: int) -> SimpleNamespace:
    """Struct types for one precision and width."""
    t = lane_types(scalar, lanes)
    S, V, V3, R3, Q, M33 = t.S, t.V, t.V3, t.R3, t.Q, t.M33
    V4 = wp.types.vector(4, S)

    @wp.struct
    class Settings:
        """What is the same for every world of a launch."""

        dt: S  # [s]
        max_steps: int  # substeps of this launch at most
        recovery: S  # fastest separation of overlapping bodies [m/s]
        max_speed: S  # clamp [m/s]
        calm_speed: S  # clamp while a world is calmed [m/s]
        margin: S  # pairs this much farther apart than touching are still listed [m]
        rest_speed: S  # slower than this is at rest [m/s]
        viscous: S  # share of their relative velocity that neighbours lose in a visit
        damp_every: int  # substeps between two visits of viscosity
        sleep: S  # mean speed below which a particle of a fabric falls asleep [m/s]; 0: none does
        sleep_after: S  # over so long [s]
        wake: S  # what would be faster wakes [m/s]
        sleep_ramp: S  # by this factor a box's sleep speed grows from 1 s to 2 s after a release
        rest_steps: S  # so many substeps at rest end a world's launch
        check_every: int  # substeps between looks of the guards
        record_every: int  # substeps between recorded frames; 0: record nothing
        particle_stride: int  # particles of all groups: length of one recorded frame
        body_stride: int  # bodies of all worlds: length of one recorded frame

    # Small structs: a function that is not inlined copies those that it takes.
    @wp.struct
    class Topology:
        """Where each topology's slice of the lists starts; (topologies,) or (topologies + 1,)."""

        particle_count: wp.array(dtype=int)
        particle_start: wp.array(dtype=int)  # in `Topology.radius`
        radius: wp.array(dtype=S)  # of particles [m]
        body_count: wp.array(dtype=int)
        spring_start: wp.array(dtype=int)
        passes: wp.array(dtype=int)  # over the springs, in a substep
        pair_start: wp.array(dtype=int)
        shape_count: wp.array(dtype=int)
        piece_start: wp.array(dtype=int)  # pieces of fabric, see `Springs`

    @wp.struct
    class Springs:
        """Distance and bending constraints between particles, numbered inside their world."""

        ij: wp.array(dtype=wp.vec2i)
        length: wp.array(dtype=S)  # [m]
        compliance: wp.array(dtype=S)  # [m/N]
        limit: wp.array(dtype=S)  # longest allowed length [m]; 0: none
        floor: wp.array(dtype=S)  # shortest allowed length [m]; 0: none
        mode: wp.array(dtype=int)
        watched: wp.array(dtype=int)  # 1: the stretch guard looks at it
        middle: wp.array(dtype=int)  # of a bending spring: the particle between the two
        run: wp.array(dtype=int)  # of a direct solve: springs from here on; 0: amid them
        # of fabrics, piece by piece: pairs of neighbours, and particles
        neighbours: wp.array(dtype=wp.vec2i)
        neighbour_first: wp.array(dtype=int)  # (pieces + 1,), as the next
        members: wp.array(dtype=int)
        member_first: wp.array(dtype=int)

    @wp.struct
    class Pairs:
        """Particles of one world that may touch."""

        ij: wp.array(dtype=wp.vec2i)
        distance: wp.array(dtype=S)  # sum of their radii [m]

    @wp.struct
    class Shapes:
        """Boxes of every world, by shape_start + lane * shape_count, with their body's number."""

        body: wp.array(dtype=int)
        center: wp.array(dtype=R3)  # in the frame of the body's centre of mass [m]
        rotation: wp.array(dtype=Q)
        half: wp.array(dtype=R3)  # half extents [m]
        friction: wp.array(dtype=S)

    @wp.struct
    class Group:
        """Per group: where its data start, and the parameters that may differ between worlds."""

        topology: wp.array(dtype=int)
        particle_start: wp.array(dtype=int)
        body_start: wp.array(dtype=int)
        near_start: wp.array(dtype=int)
        near_capacity: wp.array(dtype=int)
        contact_start: wp.array(dtype=int)
        shape_start: wp.array(dtype=int)
        active: wp.array(dtype=V)  # 1: simulate this world, 0: leave it alone
        gravity: wp.array(dtype=V3)  # [m/s^2]
        damping: wp.array(dtype=V)  # [1/s]
        table_friction: wp.array(dtype=V)
        contact_friction: wp.array(dtype=V)
        stiffness: wp.array(dtype=V)  # factor on every spring's stiffness
        calm_steps: wp.array(dtype=V)  # substeps to begin with that are clamped to calm_speed
        calm_after: wp.array(dtype=V)  # and again so many after a release
        least_steps: wp.array(dtype=V)  # a world runs at least this long after its grip path
        most_steps: wp.array(dtype=V)  # and in all at most this long

    @wp.struct
    class Particles:
        """State of all particles in lanes."""

        x: wp.array(dtype=V3)  # position [m]
        v: wp.array(dtype=V3)  # velocity [m/s]
        xp: wp.array(dtype=V3)  # position at the start of the substep
        xr: wp.array(dtype=V3)  # position when the contact list was last made
        w: wp.array(dtype=V)  # inverse mass [1/kg], 0 while gripped
        w0: wp.array(dtype=V)  # inverse mass when free
        still: wp.array(dtype=V)  # of fabrics: how long it has been near `anchor`, see `sleep` [s]
        anchor: wp.array(dtype=V3)  # [m]
        dv: wp.array(dtype=V3)  # scratch: change of the velocity [m/s]
        tether: wp.array(dtype=V)  # farthest from what is held [m], see `tether`

    @wp.struct
    class Lines:
        """Scratch of direct solves (`chain`, `beam`), by the particle where a spring begins, or
        that it bends.
        """

        along: wp.array(dtype=V3)  # direction of a spring; multiplier of a bent one
        bend: wp.array(dtype=V3)  # right side, then solution
        length: wp.array(dtype=V)  # [m]
        target: wp.array(dtype=V)  # length to be reached [m]
        elastic: wp.array(dtype=V)  # 1: with the spring's compliance, 0: rigid
        inverse: wp.array(dtype=V)  # of a pivot, which is a sum of inverse masses
        ratio: wp.array(dtype=V)  # what couples a spring to the next one, over the pivot
        ratio2: wp.array(dtype=V)  # and to the one after that
        multiplier: wp.array(dtype=V)
        turned: wp.array(dtype=V)  # derivative by the right side

    @wp.struct
    class Near:
        """Pairs close enough to touch soon, per group, in the order of the topology's pairs."""

        pair: wp.array(dtype=int)
        mask: wp.array(dtype=V)  # 1 where the pair is listed for the lane's own sake

    @wp.struct
    class Sheets:
        """Triangles of fabrics, numbered inside their world, and their particles at rest.

        Per topology: first (topologies + 1,), grid, cell, widest. Per particle as
        `Topology.radius`: skin, rest, owner, edge_gap, exempt_first (particles + 1,).
        """

        first: wp.array(dtype=int)
        grid: wp.array(dtype=int)  # cells of the list along a side
        cell: wp.array(dtype=S)  # least side of a cell [m]
        widest: wp.array(dtype=S)  # largest skin [m]
        triangle: wp.array(dtype=wp.vec3i)
        friction: wp.array(dtype=S)  # of a triangle, factor on the contact friction
        skin: wp.array(dtype=S)  # a particle's share of the distance at which things touch [m]
        rest: wp.array(dtype=R3)  # [m]
        owner: wp.array(dtype=int)  # number of the object
        exempt_first: wp.array(dtype=int)  # where the particle's own slice of `exempt` starts
        exempt: wp.array(dtype=int)  # particles that never touch triangles with this corner
        edge_first: wp.array(dtype=int)  # per topology, as `first`
        edge: wp.array(dtype=wp.vec2i)
        edge_gap: wp.array(dtype=S)  # per particle: distance at which its edges touch others [m]
        edge_widest: wp.array(dtype=S)  # per topology: largest edge_gap [m]

    @wp.struct
    class Cells:
        """Particles near triangles, per group and lane, and the cells that find them.

        A lane's own slice of `key`, `place`, ... begins at particle_start * L + lane * particles;
        that of edges at link_start + lane * edges.
        """

        head_start: wp.array(dtype=int)
        list_start: wp.array(dtype=int)
        capacity: wp.array(dtype=int)  # pairs of one lane at most
        head: wp.array(dtype=int)  # where each cell starts
        count: wp.array(dtype=int)  # pairs, by group * L + lane
        particle: wp.array(dtype=int)
        face: wp.array(dtype=int)
        gap: wp.array(dtype=S)  # distance at which they touch, negative below the triangle [m]
        link_start: wp.array(dtype=int)
        edge_moved: wp.array(dtype=int)  # as `moved`
        edge_key: wp.array(dtype=int)
        edge_sorted: wp.array(dtype=V4)
        edge_count: wp.array(dtype=int)  # pairs of edges, as `count`
        edge_a: wp.array(dtype=int)
        edge_b: wp.array(dtype=int)
        edge_ball: wp.array(dtype=V4)  # midpoint in `place`; half the length and the slack [m]
        edge_gap: wp.array(dtype=S)  # as `gap`
        met: wp.array(dtype=int)  # whether what the grip holds touched a triangle, as `count`
        xr: wp.array(dtype=V3)  # positions to which the lists refer
        slack: wp.array(dtype=V)  # a particle may go so far from there before it is listed anew [m]
        place: wp.array(dtype=V4)  # both of these, lane by lane
        moved: wp.array(dtype=int)  # 1: the particle's pairs are being listed anew
        stamp: wp.array(dtype=int)  # 1 + number of the last triangle it was found exempt from
        key: wp.array(dtype=int)  # particles by cell (see `cell_sort`)
        sorted: wp.array(dtype=V4)
        # the same memory as arrays of V3 and V, scalar by scalar (see `lane_access`)
        xr_flat: wp.array(dtype=S)
        slack_flat: wp.array(dtype=S)
        x: wp.array(dtype=S)
        xp: wp.array(dtype=S)
        w: wp.array(dtype=S)

    @wp.struct
    class Bodies:
        """State of all rigid bodies, by body_start + lane * body_count + local number."""

        x: wp.array(dtype=R3)  # centre of mass [m]
        q: wp.array(dtype=Q)
        v: wp.array(dtype=R3)  # [m/s]
        omega: wp.array(dtype=R3)  # [rad/s]
        xp: wp.array(dtype=R3)
        qp: wp.array(dtype=Q)
        w: wp.array(dtype=S)  # inverse mass [1/kg], 0 while gripped
        w0: wp.array(dtype=S)
        inertia: wp.array(dtype=M33)  # in the body's frame [kg m^2]
        inverse_inertia: wp.array(dtype=M33)
        touching: wp.array(dtype=int)  # contacts with particles and bodies in the last substep
        support: wp.array(dtype=int)  # the same and those with the table
        dx: wp.array(dtype=R3)  # correction by contacts in this substep [m]
        dr: wp.array(dtype=R3)  # the same as a rotation vector [rad]
        spread: wp.array(dtype=M33)  # inverse inertia in the world's frame [1/(kg m^2)]

    @wp.struct
    class Contacts:
        """Scratch per group, for one lane at a time: where bodies touch things and the table."""

        a: wp.array(dtype=int)  # body row, -1: the table
        b: wp.array(dtype=int)  # the upper one, if it rests on the other
        ra: wp.array(dtype=R3)  # arms from the centres of mass [m]
        rb: wp.array(dtype=R3)
        normal: wp.array(dtype=R3)  # from a to b
        u: wp.array(dtype=R3)  # across it
        v: wp.array(dtype=R3)
        weights: wp.array(dtype=R3)  # inverse masses along normal, u and v [1/kg]
        upper: wp.array(dtype=R3)  # those of body b alone [1/kg]
        steps: wp.array(dtype=R3)  # gap, with the overlap that may remain, and slip along u, v [m]
        impulse: wp.array(dtype=R3)  # along normal, u and v [kg m]
        mu: wp.array(dtype=S)
        order: wp.array(dtype=int)  # contacts by the height of what they hold
        # only in the backward sweep
        code: wp.array(
            dtype=wp.vec4i
        )  # shapes whose face and side touch, which feature, which axes
        visit: wp.array(dtype=wp.vec2i)  # of every visit: contact, kind
        log: wp.array(dtype=S)  # of every visit: impulse before, friction before its limit, sharing

    @wp.struct
    class Grips:
        """One grip per world: what is held, and the path of the tip over simulated time."""

        particle: wp.array(dtype=int)  # local number of the held particle or -1
        body: wp.array(dtype=int)  # local number of the held body or -1
        offset: wp.array(dtype=R3)  # of the held thing in the tip's frame [m]
        turn: wp.array(dtype=Q)  # rotation of the held body in the tip's frame
        tick: wp.array(dtype=int)  # substeps along the path
        knot: wp.array(dtype=int)  # segment that the tip is on
        knot_end: wp.array(dtype=int)  # number of the knot after the path's last
        time: wp.array(dtype=S)  # of each knot [s], ascending per world
        position: wp.array(dtype=R3)
        rotation: wp.array(dtype=Q)
        lower_start: wp.array(dtype=S)  # between these times contact ends the descent [s]
        lower_end: wp.array(dtype=S)
        shift: wp.array(dtype=R3)  # added to the path once contact has ended the descent
        push: wp.array(dtype=int)  # local number of a pushed particle or -1, MOST_PUSHES a world
        push_acceleration: wp.array(dtype=R3)  # [m/s^2]
        push_steps: wp.array(dtype=int)

    @wp.struct
    class Watch:
        """What the guards look at, the worst value of the launch per world, and what came out."""

        steps: wp.array(dtype=V)  # substeps simulated
        nonfinite: wp.array(dtype=V)  # 1 when a coordinate was not a number
        stretch: wp.array(dtype=V)  # longest watched spring / its rest length
        depth: wp.array(dtype=V)  # deepest a particle's centre was under the table [m]
        box_depth: wp.array(dtype=V)  # the same of the lowest corner of a box [m]
        box_overlap: wp.array(
            dtype=V
        )  # deepest that two boxes lay in each other, see `box_overlap`
        clamped: wp.array(dtype=V)  # substeps in which the speed clamp acted
        overflow: wp.array(dtype=V)  # pairs of the world that found no room in the list
        frame_x: wp.array(dtype=V3)  # recorded particle positions
        frame_body_x: wp.array(dtype=R3)
        frame_body_q: wp.array(dtype=Q)

    return SimpleNamespace(
        **vars(t),
        **vars(adjoint_structures(scalar, lanes)),
        V4=V4,
        Settings=Settings,
        Topology=Topology,
        Springs=Springs,
        Pairs=Pairs,
        Shapes=Shapes,
        Group=Group,
        Particles=Particles,
        Lines=Lines,
        Near=Near,
        Bodies=Bodies,
        Grips=Grips,
        Watch=Watch,
        Contacts=Contacts,
        Sheets=Sheets,
        Cells=Cells,
    )
