-- ================================================================================================
-- rosbayes: bm1_simulated
-- Simulated board: executes requests from standard input on the AXI4-Lite slave of bm1.
-- MIT licence; datasheet: docs/hardware/simulation.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;
  use ieee.numeric_std.all;

library std;
  use std.textio.all;

library work;
  use work.bm1_utilities.all;
  use work.bm_register_map.all;

entity bm1_simulated is
  generic (
    BOARD : natural := 0 -- index of this board in PARTITIONS
  );
end entity bm1_simulated;

architecture simulation of bm1_simulated is

  constant HALF           : time     := 5 ns;
  constant LONGEST_ACCESS : positive := 1_000_000; -- clocks, after which an access without an answer ends the simulation

  signal clk         : std_logic                                       := '0';
  signal rstn        : std_logic                                       := '0';
  signal irq         : std_logic;
  signal axi_awvalid : std_logic                                       := '0';
  signal axi_awready : std_logic;
  signal axi_wready  : std_logic;
  signal axi_address : std_logic_vector(BAR_ADDRESS_BITS - 1 downto 0) := (others => '0');
  signal axi_wdata   : std_logic_vector(31 downto 0)                   := (others => '0');
  signal axi_bvalid  : std_logic;
  signal axi_bresp   : std_logic_vector(1 downto 0);
  signal axi_arvalid : std_logic                                       := '0';
  signal axi_arready : std_logic;
  signal axi_rvalid  : std_logic;
  signal axi_rdata   : std_logic_vector(31 downto 0);
  signal axi_rresp   : std_logic_vector(1 downto 0);

begin

  board_under_simulation : entity work.bm1
    generic map (
      board         => BOARD,
      memory_folder => "Memory_MIFs/"
    )
    port map (
      clk_i       => clk,
      rstn_i      => rstn,
      irq_o       => irq,
      axi_awvalid => axi_awvalid,
      axi_awready => axi_awready,
      axi_awaddr  => axi_address,
      axi_awprot  => "000",
      axi_wvalid  => axi_awvalid,
      axi_wready  => axi_wready,
      axi_wdata   => axi_wdata,
      axi_wstrb   => "1111",
      axi_bvalid  => axi_bvalid,
      axi_bready  => '1',
      axi_bresp   => axi_bresp,
      axi_arvalid => axi_arvalid,
      axi_arready => axi_arready,
      axi_araddr  => axi_address,
      axi_arprot  => "000",
      axi_rvalid  => axi_rvalid,
      axi_rready  => '1',
      axi_rdata   => axi_rdata,
      axi_rresp   => axi_rresp
    );

  -- The clock stands still between requests, and the simulation ends with the end of standard input.
  execute_requests : process is

    variable request   : line;
    variable answer    : line;
    variable words     : line;
    variable operation : character;
    variable first     : std_logic_vector(31 downto 0);
    variable second    : std_logic_vector(31 downto 0);
    variable response  : std_logic_vector(3 downto 0);
    variable clocks    : natural;
    variable interrupt : boolean;

    procedure cycle is
    begin

      wait for HALF;

      interrupt := irq = '1';
      clocks    := clocks + 1;
      clk       <= '1';
      wait for HALF;
      clk       <= '0';

    end procedure cycle;

    procedure access_word (
      write   : boolean;
      address : natural
    ) is

      variable accepted : boolean := false;
      variable answered : boolean := false;
      variable began    : natural;

    begin

      began       := clocks;
      axi_address <= std_logic_vector(to_unsigned(address, BAR_ADDRESS_BITS));

      if (write) then
        axi_wdata   <= second;
        axi_awvalid <= '1';
      else
        axi_arvalid <= '1';
      end if;

      while not answered loop

        assert clocks - began < LONGEST_ACCESS
          report "the hardware does not answer an access"
          severity failure;
        -- the signals settle before the clock's edge
        wait for HALF;

        if (write) then
          accepted := axi_awready = '1';
          answered := axi_bvalid = '1';
          response := "00" & axi_bresp;
        else
          accepted := axi_arready = '1';
          answered := axi_rvalid = '1';
          response := "00" & axi_rresp;
        end if;

        if (answered and not write and axi_rresp = "00") then
          hwrite(words, axi_rdata);
        end if;

        cycle;

        if (accepted) then
          axi_awvalid <= '0';
          axi_arvalid <= '0';
        end if;

      end loop;

    end procedure access_word;

  begin

    while not endfile(input) loop

      readline(input, request);
      read(request, operation);
      hread(request, first);
      hread(request, second);
      response  := "0000";
      clocks    := 0;
      interrupt := false;
      words     := new string'("");

      if (operation = 'r') then

        for place in 0 to to_integer(unsigned(second)) - 1 loop

          access_word(false, to_integer(unsigned(first)) + 4 * place);
          exit when response /= "0000";

        end loop;

      elsif (operation = 'w') then
        access_word(true, to_integer(unsigned(first)));
      elsif (operation = 'c') then

        while clocks < to_integer(unsigned(first)) and not interrupt loop

          cycle;

        end loop;

        response := "000" & to_std_logic(interrupt);
      else
        rstn <= '0';
        cycle;
        cycle;
        rstn <= '1';
      end if;

      hwrite(answer, response);
      write(answer, string'(" "));
      hwrite(answer, std_logic_vector(to_unsigned(clocks, 32)));
      write(answer, string'(" "));
      write(answer, words.all);
      deallocate(words);
      writeline(output, answer);
      flush(output);

    end loop;

    wait;

  end process execute_requests;

end architecture simulation;
