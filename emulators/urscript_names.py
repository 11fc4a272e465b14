"""What a controller refuses before a program starts: names that it does not know, and calls with wrong arguments.

Source: UR's script manual. The check is over the Python that `urscript.translate` makes of a program.
"""

import ast
from collections.abc import Iterator, Set

# The parameters of the functions that the emulated controller plays; those in brackets may be left out.
_PLAYED = """
    enter_critical() exit_critical() halt() sync()
    get_actual_joint_positions() get_actual_joint_speeds() get_steptime() get_tcp_force() zero_ftsensor()
    kill(thread) norm(a) sqrt(f) textmsg(s1 [s2])
    speedj(qd a [t]) movel(pose [a v t r]) stopj(a) stopl(a [aRot])
    read_input_float_register(address) read_input_integer_register(address)
    write_output_float_register(address value) write_output_integer_register(address value)
    rtde_set_watchdog(variable_name min_frequency [action])
    force_mode_set_damping(damping) force_mode_set_gain_scaling(scaling)
"""
# Functions that ur-rtde's own script has for commands that our driver does not send: to call one ends a program.
_NOT_PLAYED = """
    direct_torque enable_external_ft_sensor end_force_mode end_freedrive_mode end_teach_mode force_mode
    freedrive_mode ft_rtde_input_enable get_actual_joint_positions_history get_actual_tcp_pose
    get_actual_tool_flange_pose get_forward_kin get_freedrive_status get_inverse_kin
    get_inverse_kin_has_solution get_joint_torques get_target_payload get_target_payload_cog
    get_target_payload_inertia get_target_tcp_speed get_target_waypoint get_tcp_offset is_steady
    is_within_safety_limits movej pose_sub pose_trans protective_stop servoc servoj set_gravity set_payload
    set_target_payload set_tcp speedl teach_mode tool_contact
"""
# What `translate` writes for statements.
_INSERTED = frozenset({"put", "count_loop", "is_interrupted"})
# Functions from PolyScope 5 on.
E_SERIES_ONLY = frozenset({"zero_ftsensor", "get_steptime"})


def _signatures() -> dict[str, tuple[list[str], int]]:
    """Return the names of each played function's parameters, and how many of them it needs."""
    found = {}
    for function in _PLAYED.replace("\n", " ").split(") "):
        name, _, parameters = function.strip().rstrip(")").partition("(")
        if name:
            needed = parameters.partition("[")[0].split()
            found[name] = parameters.replace("[", "").replace("]", "").split(), len(needed)
    return found


_SIGNATURES = _signatures()
_OTHERS = frozenset(_NOT_PLAYED.split()) | _INSERTED


def check_names(tree: ast.Module, threads: Set[str]) -> frozenset[str]:
    """Return the controller's own functions that a program calls.

    Raises:
        SyntaxError: a name is not defined, a function is called with wrong arguments, or a thread is not started by
            `run`.
    """
    functions = {node.name: node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    called: set[str] = set()
    for function in functions.values():
        nodes = list(_own_nodes(function))
        calls = [node for node in nodes if isinstance(node, ast.Call)]
        for call in calls:
            called.add(_check_call(call, functions, threads))
        _check_variables(function, nodes, {id(call.func) for call in calls}, functions)
    return frozenset(called & _SIGNATURES.keys())


def _own_nodes(function: ast.FunctionDef) -> Iterator[ast.AST]:
    """Yield the nodes of a function's body, without those of the functions in it."""
    waiting: list[ast.AST] = [*function.body]
    while waiting:
        node = waiting.pop()
        yield node
        if not isinstance(node, ast.FunctionDef):
            waiting += ast.iter_child_nodes(node)


def _check_variables(
    function: ast.FunctionDef, nodes: list[ast.AST], called: Set[int], functions: dict[str, ast.FunctionDef]
) -> None:
    """Raise SyntaxError where a function reads a variable that is neither global nor its own."""
    names = [node for node in nodes if isinstance(node, ast.Name)]
    known = {argument.arg for argument in function.args.args} | functions.keys()
    known |= {node.id for node in names if isinstance(node.ctx, ast.Store)}
    for node in nodes:
        if isinstance(node, ast.Global):
            known |= set(node.names)
    poses = {id(node.value) for node in nodes if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Tuple)}
    for node in names:
        is_pose = node.id == "p" and id(node) in poses
        if isinstance(node.ctx, ast.Load) and node.id not in known and id(node) not in called and not is_pose:
            raise SyntaxError(f"name {node.id} is not defined")


def _check_call(call: ast.Call, functions: dict[str, ast.FunctionDef], threads: Set[str]) -> str:
    """Return the name of the called function; SyntaxError where it does not exist or takes other arguments."""
    if not isinstance(call.func, ast.Name):
        raise SyntaxError("a call of something that is no function")  # noqa: TRY004 - a mistake in the program
    name = call.func.id
    if name == "run":
        (thread,) = call.args
        if not isinstance(thread, ast.Name) or thread.id not in threads:
            raise SyntaxError(f"{ast.unparse(thread)} is not a thread")
    elif name in threads:
        raise SyntaxError(f"{name} is a thread: run starts it")
    elif name in functions:
        parameters = [argument.arg for argument in functions[name].args.args]
        _check_arguments(call, name, parameters, len(parameters))
    elif name in _SIGNATURES:
        _check_arguments(call, name, *_SIGNATURES[name])
    elif name not in _OTHERS:
        raise SyntaxError(f"name {name} is not defined")
    return name


def _check_arguments(call: ast.Call, name: str, parameters: list[str], needed: int) -> None:
    given = [*parameters[: len(call.args)], *(str(keyword.arg) for keyword in call.keywords)]
    too_many = len(call.args) > len(parameters) or len(set(given)) < len(given)
    if too_many or not set(given) <= set(parameters) or not set(parameters[:needed]) <= set(given):
        raise SyntaxError(f"{name} takes other arguments than {ast.unparse(call)}")
