"""Metrics computed by other methods: float64, shapely, marching in 1 ms steps, SciPy's filter, plain loops.

For the straight roads of :mod:`scenes` and :mod:`metric_scenes`, whose lanes run along y = 0 and y = 3.7, and straight
lanes that cross them or begin on them. Written from the definitions alone; shares no code with the package.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import savgol_filter
from shapely.geometry import LineString, Point, Polygon

START, END, DT = 10, 90, 0.1
HALF, EDGE = 1.85, 1e-3
VULNERABLE_KINDS = (2, 3)
#: Metrics that depend on lines along the road.
LINES = (
    "lane_straddle", "wrong_way", "wrong_way_worst", "speeding_mean", "speeding_max", "off_route",
    "route_deviation_mean", "route_deviation_max", "progress", "progress_ratio", "log_lead",
)  # fmt: skip


def corners(x, y, heading, length, width):
    """Front left, rear left, rear right, front right."""
    cos, sin = np.cos(heading), np.sin(heading)
    local = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [length / 2, width / 2]
    return local @ np.array([[cos, sin], [-sin, cos]]) + [x, y]


def marched_ttc(ego, velocity, boxes, velocities, step_s=1e-3, horizon_s=5.0):
    """First of the moments 0, 1 ms, 2 ms, ... at which boxes overlap (separating axes on corners); 5 for none.

    Boxes are x, y, heading, length, width; ``ego [5]``, ``boxes [N, 5]``. Returns ``[N]``.
    """
    moments = np.arange(0.0, horizon_s, step_s)
    result = np.full(len(boxes), horizon_s)
    ego_corners = corners(*ego)
    for number, (box, box_velocity) in enumerate(zip(boxes, velocities, strict=True)):
        box_corners = corners(*box)
        apart = np.zeros(len(moments), bool)
        relative = np.outer(moments, box_velocity - velocity)
        for shape in (ego_corners, box_corners):
            for edge in np.diff(shape[:3], axis=0):
                axis = np.array([-edge[1], edge[0]]) / np.hypot(*edge)
                shift = relative @ axis
                low, high = (box_corners @ axis).min() + shift, (box_corners @ axis).max() + shift
                apart |= (high <= (ego_corners @ axis).min()) | (low >= (ego_corners @ axis).max())
        if not apart.all():
            result[number] = moments[np.argmin(apart)]
    return result


class StraightLane:
    """A lane of two points, as its centre line and in coordinates along and across it."""

    def __init__(self, begin, end, limit, corridor, loose):
        self.line, self.begin = LineString([begin, end]), begin
        self.length = np.hypot(*(end - begin))
        self.along = (end - begin) / self.length
        self.limit, self.corridor, self.loose = limit, corridor, loose

    def distance(self, point):
        return self.line.distance(Point(point))

    def place(self, point):
        """Arc length and lateral distance of a point."""
        to = np.asarray(point) - self.begin
        return to @ self.along, abs(self.along[0] * to[1] - self.along[1] * to[0])

    def turn(self, heading):
        """Angle to a heading, degrees."""
        return np.degrees(np.arccos(np.clip(self.along @ [np.cos(heading), np.sin(heading)], -1, 1)))


class Judge:
    """Evaluates ego's ``motion [91, 4]`` in a recording; ``ambiguous`` if a decision is near its threshold."""

    def __init__(self, recording, motion, two_way):
        self.tracks, self.motion, self.two_way = recording.tracks, motion, two_way
        self.recording = recording
        edge = next(f for f in recording.features if f.feature_id == 4)
        self.ring = Polygon(edge.points[:, :2])
        lanes = {f.feature_id: f for f in recording.features}
        ends = {number: lane.points[[0, -1], :2] for number, lane in lanes.items()}
        # Lane 3 goes on where lane 1 ends.
        ends[1] = np.stack([ends[1][0], ends[3][1]])
        corridor = (1,) if two_way else (1, 2)
        self.lanes = [
            StraightLane(*ends[number], lanes[number].limit_mps, number in corridor, number == 7)
            for number in (1, 2, 7)
            if number in lanes
        ]
        self.size = self.tracks.size[:, 0]
        self.ambiguous = False

    def ego(self, t):
        return (*self.motion[t, :3], *self.size[0, :2])

    def other(self, a, t):
        return (*self.tracks.xy[a, t], self.tracks.heading[a, t], *self.size[a, :2])

    def near(self, value, threshold, margin=EDGE):
        """Mark the scene as ambiguous if the value is so near the threshold that float32 may decide otherwise."""
        if abs(value - threshold) < margin:
            self.ambiguous = True

    def overlap(self, a, t):
        mine, theirs = Polygon(corners(*self.ego(t))), Polygon(corners(*self.other(a, t)))
        if mine.distance(theirs) > EDGE:
            return False
        if not mine.buffer(-EDGE).intersects(theirs):
            self.ambiguous = True
        return mine.intersection(theirs).area > 0

    def place(self, t):
        """Off the road, off the map, straddling, in several lanes, against traffic, limit, off the corridor."""
        centre, heading = self.motion[t, :2], self.motion[t, 2]
        box = corners(*self.ego(t))
        turns = np.array([lane.turn(heading) for lane in self.lanes])
        apart = np.array([lane.distance(centre) for lane in self.lanes])
        for turn, lane in zip(turns, self.lanes, strict=True):
            for threshold in (30.0, 90.0, 135.0):
                self.near(turn, threshold, 0.05)
            for corner in box:
                self.near(lane.distance(corner), HALF + 0.2)
                self.near(lane.place(corner)[1], HALF + 0.2)
        aligned = turns < 90
        offroad, left_map = self.outside(centre, box)
        same = [lane for lane, on in zip(self.lanes, aligned, strict=True) if on]
        outside = [all(lane.distance(corner) > HALF + 0.2 for lane in same) for corner in box]
        own = apart[aligned].min(initial=9.0)
        self.near(own, 4.0)
        several = own <= 4.0 and not any(self.holds(lane, centre, box) for lane in same)
        opposed = apart[(turns > 135) & (apart <= HALF)].min(initial=np.inf)
        for distance in apart:
            self.near(distance, HALF)
        self.near(opposed, own)
        on_corridor = apart[[lane.corridor for lane in self.lanes]].min()
        self.near(on_corridor, HALF + 0.2)
        limit = self.limit(centre, turns, apart) if own <= 4.0 else None
        return offroad, left_map, any(outside), several, opposed < own, limit, on_corridor > HALF + 0.2

    def outside(self, centre, box):
        """Whether the box is off the road, and whether its centre has left the map."""
        beyond = [self.ring.exterior.distance(Point(c)) for c in box if not self.ring.contains(Point(c))]
        for value in beyond:
            self.near(value, 0.3)
        # Far from the edges other lanes may decide.
        if max(beyond, default=0.0) > 2.9 and len(self.lanes) > 2:
            self.ambiguous = True
        points = [self.ring.exterior, *(lane.line for lane in self.lanes)]
        low = np.min([part.bounds[:2] for part in points], axis=0) - 4.0
        high = np.max([part.bounds[2:] for part in points], axis=0) + 4.0
        for value, bound in zip((*centre, *centre), (*low, *high), strict=True):
            self.near(value, bound)
        return any(value > 0.3 for value in beyond), not ((centre >= low) & (centre <= high)).all()

    def on(self, lane, centre):
        """Whether the centre is between the ends of a lane; ambiguous near the ends of a ``loose`` lane."""
        along, across = lane.place(centre)
        if lane.loose and across < 5.0:
            self.near(along, -2.0, 2.6)
            self.near(along, lane.length + 2.0, 2.6)
        return 0.0 <= along <= lane.length

    def holds(self, lane, centre, box):
        """Whether all corners are between the borders of a lane, extended straight beyond its ends."""
        return self.on(lane, centre) and max(lane.place(corner)[1] for corner in box) <= HALF + 0.2

    def limit(self, centre, turns, apart):
        """Highest limit of the lanes that contain the centre, those of the route first; else that of the nearest."""
        lanes = list(zip(self.lanes, turns, apart, strict=True))
        fit = [
            lane
            for lane, turn, _ in lanes
            if turn <= 30 and lane.line.buffer(HALF, cap_style="flat").contains(Point(centre))
        ]
        for lane, _, _ in lanes:
            self.on(lane, centre)
        if fit:
            route = [lane for lane in fit if lane.corridor]
            return max(lane.limit for lane in route or fit)
        near = sorted((distance, lane.limit) for lane, turn, distance in lanes if turn < 90)
        if len(near) > 1 and near[0][1] != near[1][1]:
            self.near(near[1][0], near[0][0])
        return near[0][1]

    def fault_and_kind(self, a, t, unlawful):
        x, y, heading, length, width = self.ego(t)
        theirs = Polygon(corners(*self.other(a, t)))
        stands = max(self.motion[t - 1, 3], self.motion[t, 3]) < 0.05
        before = self.tracks.velocity[a, t - 1] if self.tracks.valid[a, t - 1] else np.zeros(2)
        other_stands = max(np.hypot(*before), np.hypot(*self.tracks.velocity[a, t])) < 0.05
        along, left = (
            np.array([np.cos(heading), np.sin(heading)]),
            np.array([-np.sin(heading), np.cos(heading)]),
        )
        to = self.tracks.xy[a, t] - [x, y]
        angle = np.degrees(np.arctan2(abs(to @ left), to @ along + length * 1.461 / 5.176))
        self.near(angle, 150.0, 0.05)
        tips = [np.array([x, y]) + along * (length / 2 + off) for off in (-0.02, 0.0, 0.02)]
        hits = [
            LineString([tip - left * width / 2, tip + left * width / 2]).intersects(theirs) for tip in tips
        ]
        if len(set(hits)) > 1:
            self.ambiguous = True
        front, behind = hits[1], angle > 150.0
        if stands:
            fault = False
        elif other_stands:
            fault = True
        elif behind:
            fault = False
        else:
            fault = front or unlawful
        turn = np.degrees(np.arccos(np.clip(np.cos(self.tracks.heading[a, t] - heading), -1, 1)))
        self.near(turn, 135.0, 0.05)
        self.near(turn, 45.0, 0.05)
        if self.tracks.kind[a] in VULNERABLE_KINDS:
            kind = 5
        elif other_stands and front:
            kind = 6
        elif turn > 135 and (front or not behind):
            kind = 4
        elif front and turn < 45:
            kind = 1
        else:
            kind = 2 if behind else 3
        return fault, kind

    def contacts(self, places):
        """Collision and fault per step, type of the first, most ignored overlaps, and overlaps without ego's fault."""
        count = len(self.tracks.valid)
        code, were_hit = {}, set()
        hit, fault, kinds, ignored = np.zeros(91, bool), np.zeros(91, bool), [], 0
        blameless = [set() for _ in range(91)]
        for t in range(START, END + 1):
            new = []
            for a in range(1, count):
                if not self.tracks.valid[a, t]:
                    code.pop(a, None)
                elif not self.overlap(a, t):
                    code[a] = "apart"
                elif code.get(a, "ignored") == "ignored":
                    code[a] = "ignored"
                elif code[a] == "apart":
                    code[a] = "hit"
                    if a not in were_hit:
                        new.append(a)
                    were_hit.add(a)
            unlawful = places[t][0] or places[t][1] or places[t][3]
            contacts = {a: self.fault_and_kind(a, t, unlawful) for a in new}
            for a, (own, _) in contacts.items():
                if own:
                    code[a] = "own fault"
            hit[t] = any(c in ("hit", "own fault") for c in code.values())
            fault[t] = any(own for own, _ in contacts.values())
            if contacts and not kinds:
                nearest = min(contacts, key=lambda a: np.hypot(*(self.tracks.xy[a, t] - self.motion[t, :2])))
                kinds.append(contacts[nearest][1])
            ignored = max(ignored, sum(c == "ignored" for c in code.values())) if t > START else 0
            blameless[t] = {a for a, c in code.items() if c in ("hit", "ignored")}
        return hit, fault, (kinds or [0])[0], ignored, blameless

    def ttc(self, t, blameless):
        x, y, heading, length, _ = self.ego(t)
        along = np.array([np.cos(heading), np.sin(heading)])
        rows = []
        for a in range(1, len(self.tracks.valid)):
            if not self.tracks.valid[a, t] or a in blameless:
                continue
            foremost = ((corners(*self.other(a, t)) - [x, y]) @ along).max()
            self.near(foremost, -length * 1.461 / 5.176)
            if foremost > -length * 1.461 / 5.176:
                rows.append(a)
        boxes = np.array([self.other(a, t) for a in rows]).reshape(-1, 5)
        velocities = self.tracks.velocity[rows, t]

        def marched(change):
            size = np.array([0, 0, 0, change, change])
            now = self.ego(t) + size
            return marched_ttc(now, self.motion[t, 3] * along, boxes + size, velocities).min(initial=5.0)

        # Corners may touch between two moments only; slightly smaller boxes then never overlap.
        return marched(0.0), lambda: marched(-0.06)

    def red_light(self, t):
        """Whether the bumper crosses the stop line of the route's light while it is red before and after."""
        fronts = [
            self.motion[s, :2]
            + self.size[0, 0] / 2 * np.array([np.cos(self.motion[s, 2]), np.sin(self.motion[s, 2])])
            for s in (t - 1, t)
        ]
        for light in self.recording.lights:
            x = light.stop_point[0]
            red = all(light.states[s] in (1, 4) for s in (t - 1, t))
            self.near(fronts[1][0], x, 1e-4)
            if red and fronts[0][0] < x <= fronts[1][0]:
                share = (x - fronts[0][0]) / (fronts[1][0] - fronts[0][0])
                y = fronts[0][1] + share * (fronts[1][1] - fronts[0][1])
                self.near(abs(y), HALF)
                return abs(y) <= HALF
        return False

    def comfort(self):
        """Whether each step 11..90 is comfortable; the largest jerk magnitude and lateral acceleration."""
        speed, heading = self.motion[:, 3], np.unwrap(self.motion[:, 2])
        along = np.diff(speed) / DT
        lateral = (speed[1:] + speed[:-1]) / 2 * np.diff(heading) / DT
        turn = heading[1:]

        def smoothed(signal):
            # A sample before the first keeps the windows of the steps that matter away from SciPy's edge.
            return savgol_filter(np.concatenate([[0.0], signal]), 8, 2)[1:]

        def jerk(signal):
            return np.abs(savgol_filter(smoothed(signal), 15, 2, deriv=1, delta=DT))

        lat, smooth = np.abs(smoothed(lateral)), smoothed(along)
        magnitude = jerk(np.hypot(along, lateral))
        excess = np.max([
            smooth / 2.40, smooth / -4.05, lat / 4.89, magnitude / 8.37,
            jerk(along) / 4.13,
            np.abs(savgol_filter(turn, 5, 2, deriv=1, delta=DT)) / 0.95,
            np.abs(savgol_filter(turn, 5, 3, deriv=2, delta=DT)) / 1.93,
        ], axis=0)[START:]  # fmt: skip
        if (np.abs(excess - 1) < 2e-3).any():
            self.ambiguous = True
        return (excess <= 1).mean(), magnitude[START:].max(), lat[START:].max()

    def episode(self, times):
        """Metrics by name, and times to collision at every eighth step.

        At all 80 steps they would take too long: metrics of the time to collision are those of ``times``, the package's
        values. Metrics that depend on the lines of lanes or route are left out if ego drives beyond their ends.
        """
        steps = range(START + 1, END + 1)
        places = {t: self.place(t) for t in range(START, END + 1)}
        hit, fault, kind, ignored, blameless = self.contacts(places)
        moved = np.hypot(*np.diff(self.motion[START:, :2], axis=0).T)
        over = [max(0.0, self.motion[t, 3] - places[t][5]) for t in steps if places[t][5] is not None]
        wrong = np.array([moved[t - START - 1] * places[t][4] for t in steps])
        log = self.tracks.xy[0]
        apart = np.hypot(*(self.motion[START + 1 :, :2] - log[START + 1 :]).T)
        ways = np.abs(self.motion[START + 1 :, 1])
        comfort, jerk, lateral = self.comfort()
        gained, whole = max(self.motion[START:, 0].max(), 0.0), log[END, 0]
        ttc = {t: self.ttc(t, blameless[t]) for t in steps if self.motion[t, 3] >= 0.05 and t % 8 == 3}
        moving = [times[t - START - 1] for t in steps if self.motion[t, 3] >= 0.05]
        furthest = np.maximum.accumulate(self.motion[START:, 0].clip(0.0))[1:]
        log_furthest = np.maximum.accumulate(log[START:, 0].clip(0.0))[1:]
        lead = DT * (furthest - log_furthest).sum() / whole if whole >= 0.5 else None
        goal = np.hypot(*(self.motion[END, :2] - log[END]))
        ratio = 1.0 if whole < 0.5 else np.clip(gained / whole, 0, 1)
        result = {
            "collision": hit[START + 1 :].any(), "at_fault_collision": fault.any(), "collision_type": kind,
            "ignored_overlaps": ignored, "offroad": any(places[t][0] for t in steps),
            "left_map": any(places[t][1] for t in steps), "red_light": any(self.red_light(t) for t in steps),
            "lane_straddle": DT * sum(places[t][2] for t in steps), "wrong_way": wrong.sum(),
            "wrong_way_worst": max(wrong[max(0, i - 9) : i + 1].sum() for i in range(80)),
            "speeding_mean": np.mean(over) if over else None, "speeding_max": max(over) if over else None,
            "off_route": any(places[t][6] for t in steps), "route_deviation_mean": ways.mean(),
            "route_deviation_max": ways.max(), "ade": apart.mean(), "fde": apart[-1], "distance": moved.sum(),
            "progress": gained, "progress_ratio": ratio, "log_lead": lead, "goal_distance": goal, "comfort": comfort,
            "max_jerk": jerk, "max_lateral_acceleration": lateral, "comfortable": comfort == 1.0,
            "min_ttc": min(moving, default=None), "average_ttc": np.mean(moving) if moving else None,
            "ttc_ok": all(value >= 0.95 for value in moving),
        }  # fmt: skip
        for value, threshold in ((ratio, 0.2), (ratio, 0.95), (goal, 3.0)):
            self.near(value, threshold)
        if self.motion[:, 0].max() > min(self.ring.bounds[2] - 5, log[END, 0] + 45):
            return {name: value for name, value in result.items() if name not in LINES}, ttc
        result |= scores(result)
        return result | {"success_moving": result["success"] if whole - log[START, 0] > 5 else None}, ttc


def scores(metrics):
    """The two scores and their inputs, by their formulas, from the other metrics of an episode."""
    over = metrics["speeding_mean"]
    speed = None if over is None else max(0.0, 1 - over / 2.23)
    worst, straddle = metrics["wrong_way_worst"], round(metrics["lane_straddle"], 3)
    direction = 1.0 if worst <= 2 else 0.5 if worst <= 6 else 0.0
    lanes = 1.0 if straddle <= 3.4 else 0.5 if straddle <= 5.7 else 0.0
    least = 5.0 if metrics["min_ttc"] is None else metrics["min_ttc"]
    gates = (
        (1 - metrics["at_fault_collision"])
        * (1 - metrics["offroad"])
        * (metrics["progress_ratio"] >= 0.2)
        * direction
    )
    terms = 5 * (least >= 0.95) + 5 * metrics["progress_ratio"] + 2 * (metrics["comfort"] > 1 - 1e-6)
    red = 1 - metrics["red_light"]
    clean = not (metrics["collision"] or metrics["offroad"] or metrics["red_light"])
    lawful = not (metrics["at_fault_collision"] or metrics["offroad"] or metrics["red_light"])
    reached = metrics["goal_distance"] <= 3 or metrics["progress_ratio"] >= 0.95
    result = {
        "making_progress": metrics["progress_ratio"] >= 0.2,
        "accuracy": clean, "accuracy_at_fault": lawful, "reached_goal": reached, "success": clean and reached,
        "direction": direction, "lane_keeping": lanes, "speed_compliance": speed,
    }  # fmt: skip
    if speed is None:
        nuplan, vmax = gates * terms / 12, gates * red * (terms + 3 * lanes) / 15
        return result | {
            "nuplan_score_partial": nuplan,
            "vmax_score_partial": vmax,
            "vmax_score": None,
            "nuplan_score": None,
        }
    nuplan, vmax = gates * (terms + 4 * speed) / 16, gates * red * (terms + 4 * speed + 3 * lanes) / 19
    return result | {"nuplan_score": nuplan, "vmax_score": vmax, "vmax_score_partial": None}
