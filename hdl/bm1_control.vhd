-- ================================================================================================
-- rosbayes: bm1_control
-- Sequence of a frame: loads codes and seeds, runs cycles, and stops each replica (thesis, 3.2).
-- MIT licence; datasheet: docs/hardware/bm1_control.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;
  use ieee.numeric_std.all;

library work;
  use work.bm_register_map.all;

entity bm1_control is
  generic (
    REPLICAS     : positive; -- number of replicas: machines that share the generators
    COUNTER_BITS : positive; -- width of a line's counter
    RESET_BANK   : boolean   -- true: each frame restarts the generators
  );
  port (
    -- system
    clk_i : in    std_logic; -- clock
    rst_i : in    std_logic; -- reset of the board
    -- commands, one clock long
    start_i  : in    std_logic; -- start a frame
    resume_i : in    std_logic; -- run the frame's next slice
    reset_i  : in    std_logic; -- stop, and clear counters and cycles
    -- settings
    target_i     : in    std_logic_vector(COUNTER_BITS - 1 downto 0); -- target count; latched by a start
    max_cycles_i : in    std_logic_vector(63 downto 0);               -- maximum cycles; latched by a start
    run_until_i  : in    std_logic_vector(63 downto 0);               -- cycles at the slice's end (0: no end); stable while running
    halt_i       : in    std_logic_vector(REPLICAS - 1 downto 0);     -- replicas to halt; latched by a resume
    -- matrices
    overflow_i   : in    std_logic_vector(REPLICAS - 1 downto 0);     -- a counter of the replica is at the target
    impossible_i : in    std_logic_vector(REPLICAS - 1 downto 0);     -- every line of the replica has a code 0
    load_o       : out   std_logic;                                   -- latch the codes of the frame
    clear_o      : out   std_logic;                                   -- clear the counters
    enable_o     : out   std_logic_vector(REPLICAS - 1 downto 0);     -- replicas that run a cycle
    target_o     : out   std_logic_vector(COUNTER_BITS - 1 downto 0); -- target count of the frame
    -- generators
    seeds_ready_i  : in    std_logic; -- the seeds are loaded
    restart_o      : out   std_logic; -- load seeds
    restart_bank_o : out   std_logic; -- 1: load seeds of the selected bank, 0: of bank 0
    step_o         : out   std_logic; -- 1: a replica runs a cycle
    -- outcome
    running_o         : out   std_logic;                                   -- the machine runs
    done_o            : out   std_logic;                                   -- the machine stops in this clock
    has_run_o         : out   std_logic;                                   -- the machine has run since the last reset
    cycles_o          : out   std_logic_vector(63 downto 0);               -- cycles of the frame
    reason_o          : out   std_logic_vector(2 downto 0);                -- stop reason
    ready_o           : out   std_logic_vector(REPLICAS - 1 downto 0);     -- bit r: replica r can be resumed
    replica_reasons_o : out   std_logic_vector(3 * REPLICAS - 1 downto 0); -- stop reason of each replica
    replica_cycles_o  : out   std_logic_vector(64 * REPLICAS - 1 downto 0) -- cycles of each replica
  );
end entity bm1_control;

architecture rtl of bm1_control is

  subtype reason_t is std_logic_vector(2 downto 0);

  type reasons_t is array (0 to REPLICAS - 1) of reason_t;

  type cycles_t is array (0 to REPLICAS - 1) of unsigned(63 downto 0);

  type state_t is (idle, loading, running);

  constant REASON_NONE       : reason_t := std_logic_vector(to_unsigned(STOP_REASON_NONE, 3));
  constant REASON_OVERFLOW   : reason_t := std_logic_vector(to_unsigned(STOP_REASON_OVERFLOW, 3));
  constant REASON_MAX_CYCLES : reason_t := std_logic_vector(to_unsigned(STOP_REASON_MAX_CYCLES, 3));
  constant REASON_SLICE      : reason_t := std_logic_vector(to_unsigned(STOP_REASON_SLICE, 3));
  constant REASON_IMPOSSIBLE : reason_t := std_logic_vector(to_unsigned(STOP_REASON_IMPOSSIBLE, 3));

  signal state      : state_t                                     := idle;
  signal cycles     : unsigned(63 downto 0)                       := (others => '0');
  signal max_cycles : unsigned(63 downto 0)                       := (others => '0');
  signal target     : std_logic_vector(COUNTER_BITS - 1 downto 0) := (others => '0');
  signal reasons    : reasons_t                                   := (others => REASON_NONE);
  signal ran        : cycles_t                                    := (others => (others => '0'));
  signal going      : std_logic_vector(REPLICAS - 1 downto 0)     := (others => '0');
  signal halted     : std_logic_vector(REPLICAS - 1 downto 0)     := (others => '0');
  signal has_run    : std_logic                                   := '0';
  signal ready      : std_logic_vector(REPLICAS - 1 downto 0);
  signal at_max     : std_logic;
  signal at_slice   : std_logic;
  signal enable     : std_logic_vector(REPLICAS - 1 downto 0);
  signal start      : std_logic;
  signal resume     : std_logic;
  signal loaded     : std_logic;
  signal stopped    : std_logic;

begin

  start  <= '1' when start_i = '1' and reset_i = '0' and rst_i = '0' and state = idle else
            '0';
  resume <= '1' when resume_i = '1' and reset_i = '0' and rst_i = '0' and state = idle else
            '0';
  loaded <= '1' when state = loading and seeds_ready_i = '1' else
            '0';

  -- The limits are compared with the cycles so far, so no cycle runs in the clock that detects the end.
  at_max   <= '1' when cycles = max_cycles else
              '0';
  at_slice <= '1' when cycles = unsigned(run_until_i) and unsigned(run_until_i) /= 0 else
              '0';

  each_replica : for r in 0 to REPLICAS - 1 generate
    enable(r) <= '1' when state = running and going(r) = '1' and (overflow_i(r) or at_max or at_slice) = '0' else
                 '0';
    ready(r)  <= '1' when reasons(r) = REASON_SLICE and halted(r) = '0' else
                 '0';

    sequence_of_replica : process (clk_i) is
    begin

      if rising_edge(clk_i) then
        if (rst_i = '1' or reset_i = '1') then
          going(r)   <= '0';
          halted(r)  <= '0';
          reasons(r) <= REASON_NONE;
        elsif (start = '1') then
          halted(r)  <= '0';
          reasons(r) <= REASON_NONE;
        elsif (resume = '1') then
          halted(r) <= halted(r) or halt_i(r);
          going(r)  <= ready(r) and not halt_i(r);
        elsif (loaded = '1') then
          going(r) <= not impossible_i(r);
          if (impossible_i(r) = '1') then
            reasons(r) <= REASON_IMPOSSIBLE;
          end if;
        elsif (state = running and going(r) = '1' and enable(r) = '0') then
          going(r) <= '0';
          if (overflow_i(r) = '1') then
            reasons(r) <= REASON_OVERFLOW;
          elsif (at_max = '1') then
            reasons(r) <= REASON_MAX_CYCLES;
          else
            reasons(r) <= REASON_SLICE;
          end if;
        end if;
      end if;

    end process sequence_of_replica;

    own_cycles : if REPLICAS > 1 generate

      count_own_cycles : process (clk_i) is
      begin

        if rising_edge(clk_i) then
          if (rst_i = '1' or reset_i = '1' or start = '1') then
            ran(r) <= (others => '0');
          elsif (state = running and going(r) = '1' and enable(r) = '0') then
            ran(r) <= cycles;
          end if;
        end if;

      end process count_own_cycles;

    else generate
      ran(r) <= cycles;
    end generate own_cycles;

    replica_reasons_o(3 * r + 2 downto 3 * r)   <= reasons(r);
    replica_cycles_o(64 * r + 63 downto 64 * r) <= std_logic_vector(ran(r));
  end generate each_replica;

  sequence_of_frame : process (clk_i) is
  begin

    if rising_edge(clk_i) then
      if (rst_i = '1' or reset_i = '1') then
        state   <= idle;
        cycles  <= (others => '0');
        has_run <= '0';
      else
        -- no case: GHDL's synthesis turns a case over an enumeration into latches
        if (state = idle) then
          if (start = '1') then
            state      <= loading;
            cycles     <= (others => '0');
            max_cycles <= unsigned(max_cycles_i);
            target     <= target_i;
          elsif (resume = '1') then
            state <= running;
          end if;
        elsif (state = loading) then
          if (loaded = '1') then
            state <= running;
          end if;
        else
          if (stopped = '1') then
            state   <= idle;
            has_run <= '1';
          else
            cycles <= cycles + 1;
          end if;
        end if;
      end if;
    end if;

  end process sequence_of_frame;

  -- A frame in which no replica can count also ends here, without a cycle.
  stopped <= '1' when state /= idle and state /= loading and (or enable) = '0' else
             '0';

  join_reasons : process (all) is

    variable joint : reason_t;

  begin

    joint := REASON_NONE;

    for r in 0 to REPLICAS - 1 loop

      if (reasons(r) = REASON_IMPOSSIBLE and joint = REASON_NONE) then
        joint := REASON_IMPOSSIBLE;
      end if;

    end loop;

    for r in 0 to REPLICAS - 1 loop

      if (reasons(r) = REASON_MAX_CYCLES) then
        joint := REASON_MAX_CYCLES;
      end if;

    end loop;

    for r in 0 to REPLICAS - 1 loop

      if (reasons(r) = REASON_OVERFLOW) then
        joint := REASON_OVERFLOW;
      end if;

    end loop;

    if ((or ready) = '1') then
      joint := REASON_SLICE;
    end if;

    if (state /= idle) then
      joint := REASON_NONE;
    end if;

    reason_o <= joint;

  end process join_reasons;

  load_o         <= start;
  clear_o        <= rst_i or reset_i or start;
  enable_o       <= enable;
  target_o       <= target;
  restart_o      <= '1' when reset_i = '1' or (start = '1' and RESET_BANK) else
                    '0';
  restart_bank_o <= start;
  step_o         <= or enable;
  running_o      <= '0' when state = idle else
                    '1';
  done_o         <= stopped and not reset_i and not rst_i;
  has_run_o      <= has_run;
  cycles_o       <= std_logic_vector(cycles);
  ready_o        <= ready;

end architecture rtl;
