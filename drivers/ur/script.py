"""The control script on the robot: ur-rtde's own, with a watchdog and limits that need no client.

The client gives each motion a deadline, by the script's own clock, in an input register that ur-rtde leaves free, and
extends it. The script turns the wrist no further than the deadline, its range and its largest force and torque allow.
It stops a linear move that its client does not stop, and ends. The watchdog is slower: a program that ends while the
arm moves may end in a protective stop.
"""

import hashlib
import re
from dataclasses import dataclass

from shearloop.drivers.ur.settings import MOVE_GRACE_S, Six, UrSettings


@dataclass(frozen=True, slots=True)
class ScriptRegisters:
    """One half of the controller's registers: the script takes commands in the first ones, and deadlines in the last.

    RTDE guide: those from 24 on are for RTDE clients; fieldbuses and their URCaps use the lower half.
    """

    first: int

    @property
    def last(self) -> int:
        """The number of our registers; ur-rtde 1.6.5 uses the first fifteen or so."""
        return self.first + 23

    @property
    def command(self) -> str:
        """The input with the number of ur-rtde's command."""
        return f"input_int_register_{self.first}"

    @property
    def state(self) -> str:
        """The output with the state of the script."""
        return f"output_int_register_{self.first}"

    @property
    def deadline(self) -> str:
        """The input with the deadline of a motion, in ticks."""
        return f"input_int_register_{self.last}"

    @property
    def clock(self) -> str:
        """The output with the script's ticks."""
        return f"output_int_register_{self.last}"

    @property
    def step(self) -> str:
        """The output with the time of one tick, in s."""
        return f"output_double_register_{self.last}"

    @property
    def inputs(self) -> tuple[str, ...]:
        """All inputs that ur-rtde and we write."""
        return (
            *(f"input_int_register_{self.first + number}" for number in range(8)),
            *(f"input_double_register_{self.first + number}" for number in range(14)),
            self.deadline,
        )


UPPER, LOWER = ScriptRegisters(24), ScriptRegisters(0)
# The clock starts at 0: with this deadline no motion begins or goes on.
NO_MOTION_TICKS = -1
# A deadline lies this much further ahead at most: a cycle of the slowest controller, for rounding.
_SLACK_S = 0.008

# ur-rtde 1.6.5: the line before the main loop, and the thread that carries out speeds.
_BEFORE_LOOP = "        keep_running = True\n"
# ur-rtde writes the number of its first register where it has a comment.
_REGISTER_OFFSET = re.compile(r"(global reg_offset_\w+ =) #.*")
_SPEED_THREAD = re.compile(r"^    thread speed_thread\(\):\n.*?^    end\n", re.MULTILINE | re.DOTALL)

# SHA-256 of the scripts of ur-rtde 1.6.5, by the first version of PolyScope that gets it.
KNOWN_SCRIPTS = {
    "f34786f9fb2c6f80561f1a0713033706c953bf33a76049cd0e73270d2e863ae0",  # 3.3
    "8e0616391131998ef6434384eeced7ba5b663692e6f73e2059ad6381a04899af",  # 3.5
    "1f59fc1c18d3801517d78509bed2900254cb521130eeccc716916eebabaeac8e",  # 3.6
    "1ddb08f05b8ac369189d7a87cfd2690f87fe2b5a56d4452be41e50d5a08c4a04",  # 3.8
    "f642abf419f28a9c334e7bfcc1f88e35214fa0fdce280aa2dd883308fe776687",  # 3.15
    "b68d3dacfa0af3fb04227c2c56040612bb3a231ddf4ea1969af7f42850c7dbb2",  # 5.0
    "cb5cc0e11edf9b2f367e5adbb2ce6aac5db088f4bee13ccbe7a2c0049ce3c43b",  # 5.3
    "1bd7982e32de4a2c51e5edd4db6269b80bb7f9f835ac8cf9ac4c6aacaa058b07",  # 5.4
    "99d5988ea08987540e200b397d2dc1d89ec28303c0c6f9f7f41ca1f483d1257d",  # 5.9
    "cee5df29e6ec0338b10f6564c9ecb4bc18ac530f4f49c29ae1c72418664dc7e7",  # 5.10
    "e23e363bca4235f8431ef8f92e2cadd56b47aaf8a2278a1bef4b2845e122fd36",  # 5.23
    "efc340698075a61465fd87a12c950a3742a99d8a1e2d8b38cb27c2fb1538825c",  # 5.26
}

# speedj returns after a cycle, so that each cycle checks. The clock starts at 0 in each program, and a deadline too far
# ahead is an older program's. It counts cycles: a sum of times would drift, for URScript's numbers may have 32 bits. An
# overload stops the wrist until the client asks for rest. The deadline of a straight move comes over another connection
# than the move, perhaps after it, so that a move that has just begun is not judged.
_GUARD = """\
    global guard_ticks = 0
    global guard_rested = 0
    global guard_bias = [0, 0, 0, 0, 0, 0]

    def guard_left_s():
        return (read_input_integer_register({register}) - guard_ticks) * {step}
    end

    def guard_end_move():
        # Two threads that move the arm are an error: the others end first.
        enter_critical
        kill move_thrd
        move_thrd = 0
        if stop_thrd != 0:
            kill stop_thrd
            stop_thrd = 0
        end
        exit_critical
        textmsg("shearloop: the straight move was not renewed in time: the arm stops and the program ends")
        stopj({hardest})
        halt
    end

    thread guard_clock():
        write_output_float_register({register}, {step})
        while (True):
            guard_ticks = guard_ticks + 1
            write_output_integer_register({register}, guard_ticks)
            if move_thrd == 0:
                guard_rested = guard_ticks
            elif guard_left_s() < -{grace} and (guard_ticks - guard_rested) * {step} > {grace}:
                guard_end_move()
            end
            sync()
        end
    end

    def guard_is_overloaded():
        load = get_tcp_force()
        force_n = norm([load[0] + guard_bias[0], load[1] + guard_bias[1], load[2] + guard_bias[2]])
        torque_nm = norm([load[3] + guard_bias[3], load[4] + guard_bias[4], load[5] + guard_bias[5]])
        return force_n > {force} or torque_nm > {torque}
    end

    def guard_largest_speed(asked):
        left = guard_left_s()
        q = get_actual_joint_positions()
        room = ({upper}) - q[5]
        if asked < 0:
            room = q[5] - ({lower})
        end
        if left < 0 or left > {longest} or room <= 0:
            return 0.0
        end
        largest = sqrt(2 * {braking} * room)
        if largest > {speed}:
            return {speed}
        end
        return largest
    end

    thread speed_thread():
        overloaded = False
        late = False
        while (True):
            enter_critical
            asked = speed_target[5]
            acceleration = speed_acceleration
            exit_critical
            overloaded = asked != 0 and (overloaded or guard_is_overloaded())
            largest = guard_largest_speed(asked)
            was_late = late
            late = asked != 0 and guard_left_s() < 0
            if late and not was_late:
                textmsg("shearloop: the wrist's speed was not renewed in time: the wrist stops")
            end
            if overloaded:
                largest = 0.0
            end
            if norm(asked) > largest:
                acceleration = {hardest}
                if asked < 0:
                    asked = 0.0 - largest
                else:
                    asked = largest
                end
            end
            if acceleration > {hardest}:
                acceleration = {hardest}
            end
            speedj([0, 0, 0, 0, 0, asked], a=acceleration, t={step})
        end
    end
"""
_START = """\
        rtde_set_watchdog("{command}", {watchdog_hz:g}, "stop")
        clock_thrd = run guard_clock()
"""
_ZEROES = "            zero_ftsensor()\n"
_NO_BIAS = "            guard_bias = [0, 0, 0, 0, 0, 0]\n"
# The arm stands as the program starts, so that what it held before is the load.
_CARRY = """\
        started_with = get_tcp_force()
        guard_bias = [{differences}]
"""


def hash_of(script: str) -> str:
    """Return a script's SHA-256 in hexadecimal digits, as in `KNOWN_SCRIPTS`."""
    return hashlib.sha256(script.encode()).hexdigest()


def own_script_hash() -> str:
    """Return the SHA-256 of what this module adds to ur-rtde's script, before the settings' values."""
    return hash_of("".join((_GUARD, _START, _NO_BIAS, _CARRY)))


def guard_script(script: str, settings: UrSettings, registers: ScriptRegisters = UPPER) -> str:
    """Return ur-rtde's script as a program with its watchdog and its limits, or "" where it is of an unknown form.

    ur-rtde arms the watchdog by a command once the script runs. Until then a script would outlive its client. URScript
    manual, `rtde_set_watchdog`: a program's watchdogs end with it.
    """
    if script.count(_BEFORE_LOOP) != 1 or len(_SPEED_THREAD.findall(script)) != 1:
        return ""
    limits = settings.limits
    margin = limits.joints.margin_rad
    values = {
        "register": registers.last,
        "command": registers.command,
        "step": settings.facts.step,
        "watchdog_hz": settings.watchdog_hz,
        "grace": MOVE_GRACE_S,
        "longest": settings.command_timeout_s + _SLACK_S,
        "lower": limits.joints.lower_rad[5] + margin,
        "upper": limits.joints.upper_rad[5] - margin,
        "speed": limits.wrist_speed_rad_per_s.inner,
        "braking": limits.wrist_acceleration_rad_per_s2.inner,
        "hardest": limits.wrist_acceleration_rad_per_s2.hard,
        "force": limits.force_n.hard,
        "torque": limits.torque_nm.hard,
    }
    script = _REGISTER_OFFSET.sub(rf"\g<1> {registers.first}", script)
    script = script.replace(_ZEROES, _ZEROES + _NO_BIAS)
    script = _SPEED_THREAD.sub(lambda _: _GUARD.format(**values), script)
    return f"def rtde_control():\n{script.replace(_BEFORE_LOOP, _START.format(**values) + _BEFORE_LOOP)}end\n"


def carry_wrench(script: str, wrench: Six) -> str:
    """Return a guarded script that judges forces by the zero from before its start, with which `wrench` was measured.

    It is in N and N·m in the base's frame; turns about the tool's axis do not change what lies along that axis.
    """
    differences = ", ".join(f"{value:.6f} - started_with[{index}]" for index, value in enumerate(wrench))
    return script.replace(_BEFORE_LOOP, _CARRY.format(differences=differences) + _BEFORE_LOOP)
